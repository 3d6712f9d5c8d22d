"""A capture that trains on few of its photographs and scores all others.

    python benchmarks/cut_capture.py CAPTURE N OUT

OUT gets links to the capture's folders and a train.txt of N photographs, evenly spread.
"""

import argparse
from pathlib import Path

import scene_experts as se


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("count", type=int, metavar="N")
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    kept = se.load_capture(args.capture, split="none", max_views=args.count).names
    args.out.mkdir(parents=True)
    for part in args.capture.resolve().iterdir():
        (args.out / part.name).symlink_to(part)
    (args.out / "train.txt").write_text("\n".join(kept) + "\n")


if __name__ == "__main__":
    main()
