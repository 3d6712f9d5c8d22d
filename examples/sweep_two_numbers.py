"""Train every combination of two numbers, and print a table of scores.

python examples/sweep_two_numbers.py CAPTURE --iterations 3000
"""

import argparse

import scene_experts as se

parser = argparse.ArgumentParser()
parser.add_argument("capture")
parser.add_argument("--iterations", type=int, default=3000)
parser.add_argument("--experts", type=int, nargs="+", default=[3, 5])
parser.add_argument("--voxel", type=float, nargs="+", default=[0.01, 0.02])
arguments = parser.parse_args()

capture = se.load_capture(arguments.capture, resolution="longest:400")
print("experts  voxel   PSNR   SSIM    MB")
for experts in arguments.experts:
    for voxel in arguments.voxel:
        scene = {"voxel_size": voxel, "decoder": {"num": experts}}
        run = se.train(se.recipe("moe-gs", iterations=arguments.iterations, scene=scene), capture, progress=False)
        scores = run.evaluate(lpips=False)
        print(f"{experts:7}  {voxel:5.3f}  {scores.psnr:5.2f}  {scores.ssim:.3f}  {scores.details['size']['MB']:4.1f}")
