"""The process that runs pycolmap: its messages, tested without pycolmap."""

import ast
import json
import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from scene_experts.sfm import worker

SOURCE = Path(worker.__file__)


def test_the_worker_imports_only_pycolmap_numpy_and_the_standard_library():
    found = set()
    for node in ast.walk(ast.parse(SOURCE.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add((node.module or "").split(".")[0])
    assert found - set(sys.stdlib_module_names) - {"__future__"} == {"pycolmap", "numpy"}  # pycolmap loads numpy


def test_a_missing_pycolmap_is_reported(tmp_path):
    ask = json.dumps({"seed": 0}) + "\n"
    code = f"import sys, runpy; sys.modules['pycolmap'] = None; runpy.run_path({str(SOURCE)!r}, run_name='__main__')"
    done = subprocess.run([sys.executable, "-c", code], input=ask, capture_output=True, text=True)
    assert done.returncode == 0 and json.loads(done.stdout)["step"] == "missing"


class Image:
    def __init__(self, name):
        self.name = name


class Model:
    """A stand-in for a reconstruction of the photographs `names`."""

    def __init__(self, names, written):
        self.images, self.cameras, self.written = {i: Image(name) for i, name in enumerate(names)}, {}, written

    def num_reg_images(self):
        return len(self.images)

    def num_points3D(self):
        return 10 * len(self.images)

    def write_binary(self, folder):
        self.written.append("".join(image.name for image in self.images.values()))

    def reg_image_ids(self):
        return list(self.images)

    def compute_mean_reprojection_error(self):
        return 0.5

    compute_mean_observations_per_reg_image = compute_mean_reprojection_error


@pytest.fixture
def reconstruct(tmp_path, monkeypatch):
    """Return a function that runs the mappers with given results and returns which ran and what was written. None: the mapper fails."""
    calls = []

    def reconstructed(incremental, at_once, mapper="auto"):
        ran, written = [], []

        def mapping(name, models):
            def run(colmap, ask, out, total):
                ran.append(name)
                if models is None:
                    raise RuntimeError("no good pair")
                return {i: Model(names, written) for i, names in enumerate(models)}

            return run

        calls.append(None)
        monkeypatch.setattr(worker, "MAPPERS", {"incremental": mapping("incremental", incremental), "global": mapping("global", at_once)})
        monkeypatch.setattr(worker, "explain_missing", lambda *_: {})
        folder = tmp_path / str(len(calls))
        ask = {"maps": str(folder / "maps"), "model": str(folder / "model"), "groups": [list("abcdefghij")], "mapper": mapper}
        return ran, written, worker.estimate_poses(None, ask)

    return reconstructed


def test_the_second_mapper_is_tried_if_the_first_leaves_many_out(reconstruct, capsys):
    ran, written, found = reconstruct(["abcdefghi", "abj"], ["abcdefghij"])
    assert ran == ["incremental"] and written == ["abcdefghi"] and found["registered"] == list("abcdefghi")
    assert found["apart"] == [1]  # only j of the second model is in no other model
    ran, written, found = reconstruct(["abcd"], ["abcdefg"])
    assert ran == ["incremental", "global"] and written == ["abcdefg"] and found["mapper"] == "global" and found["apart"] == []
    assert found["mappers"] == {"incremental": 4, "global": 7} and found["lacking"] == list("efghij")
    assert json.loads(capsys.readouterr().out.splitlines()[-2])["posed"] == 4  # said before the second mapper starts
    ran, written, found = reconstruct(["abcd"], None)
    assert written == ["abcd"] and found["mapper"] == "incremental"
    ran, written, found = reconstruct([], [], mapper="global")
    assert ran == ["global"] and not written and found == {"registered": [], "lacking": list("abcdefghij")}


def test_why_a_photograph_has_no_pose():
    posed = {1, 2}
    words = [
        worker.explain(30, {1: 90}, posed, False),
        worker.explain(3000, {1: 90}, posed, True),
        worker.explain(3000, {1: 0}, posed, False),
        worker.explain(3000, {3: 40}, posed, False),
        worker.explain(3000, {1: 40, 2: 20, 3: 99}, posed, False),
    ]
    assert len(set(words)) == 5 and "30 features" in words[0] and "2 photographs" in words[4] and "at most 40" in words[4]


def test_photographs_that_fit_too_few_others_are_weak():
    names = list("abcdefgh")
    whole = [[one, other] for one in "abcde" for other in "abcde" if one < other]
    apart = [[one, other] for one in "fgh" for other in "fgh" if one < other]
    assert worker.find_weak(names, [*whole, *apart]) == set("fgh")
    assert worker.find_weak(names, [*whole, *([n, m] for n in "fgh" for m in "abcd")]) == set()
    assert worker.find_weak(names, [*whole, *([n, m] for n in "fgh" for m in "abc")]) == set("fgh")
    assert worker.find_weak(["a", "b"], []) == {"a", "b"}


def test_spare_pairs_are_matched_for_weak_photographs_alone(monkeypatch, capsys):
    matched = []

    class Database:
        @staticmethod
        @contextmanager
        def open(path):
            yield Database

        @staticmethod
        def read_all_images():
            return [SimpleNamespace(image_id=i, name=name) for i, name in enumerate("abcdef")]

        @staticmethod
        def read_two_view_geometry_num_inliers():
            pairs = [(i, j) for i in range(5) for j in range(i + 1, 5)]
            return [*pairs, (0, 5)], [30] * len(pairs) + [0]

    colmap = SimpleNamespace(Database=Database, pair_id_to_image_pair=lambda pair: pair)
    monkeypatch.setattr(worker, "match_pairs", lambda colmap, ask, pairs: matched.append(pairs))
    ask = {"database": "", "pairs": [["a", "b"]], "spare": [["a", "c"], ["b", "f"], ["e", "f"]]}
    worker.match_all(colmap, ask)
    assert matched == [[["a", "b"]], [["b", "f"], ["e", "f"]]]
    assert json.loads(capsys.readouterr().out) == {"step": "weak", "photographs": 1, "pairs": 2}
    matched.clear()
    worker.match_all(None, {**ask, "spare": []})
    assert matched == [[["a", "b"]]]


def test_the_worker_ends_when_its_parent_ends(tmp_path):
    """The parent is killed while a stand-in for pycolmap sleeps."""
    (tmp_path / "pycolmap.py").write_text("import time\ndef set_random_seed(seed):\n    print('here', flush=True)\n    time.sleep(60)\n")
    code = "import os, subprocess, sys; p = subprocess.Popen([sys.executable, sys.argv[1]], stdin=subprocess.PIPE); " \
        "p.stdin.write(b'{\"seed\": 0}\\n'); p.stdin.flush(); print(p.pid, flush=True); import time; time.sleep(60)"  # fmt: skip
    env = {**os.environ, "PYTHONPATH": str(tmp_path)}
    parent = subprocess.Popen([sys.executable, "-c", code, str(SOURCE)], stdout=subprocess.PIPE, text=True, env=env)
    said = {parent.stdout.readline().strip(), parent.stdout.readline().strip()}
    parent.kill()
    assert "here" in said
    assert parent.stdout.read() == ""  # returns when the worker, which holds the other end, ends
    parent.wait()


def test_learned_matches_are_added_to_those_that_colmap_verified(tmp_path, monkeypatch):
    """Photographs 1 and 2 have matches of both kinds, 2 and 3 learned ones alone, given in the other order."""
    written = {}

    class Database:
        @staticmethod
        @contextmanager
        def open(path):
            written["path"] = path
            yield Database

        read_all_images = staticmethod(lambda: [SimpleNamespace(image_id=i, name=f"{i}.jpg") for i in (1, 2, 3)])
        read_keypoints = staticmethod(lambda i: np.full((i % 3, {1: 4, 2: 6, 3: 0}[i]), 9, np.float32))  # the third has none
        read_two_view_geometries = staticmethod(lambda: ([(1, 2)], [SimpleNamespace(inlier_matches=np.array([[0, 1]], np.uint32))]))
        write_keypoints = staticmethod(lambda i, rows: written.update({i: rows}))
        write_matches = staticmethod(lambda i, j, rows: written.update({(i, j): rows.tolist()}))
        clear_matches = clear_two_view_geometries = clear_keypoints = staticmethod(lambda: None)

    def verify(path, pairs, options):
        written["pairs"], written["seed"] = Path(pairs).read_text().splitlines(), options.ransac.random_seed

    colmap = SimpleNamespace(
        Database=Database,
        pair_id_to_image_pair=lambda key: key,
        verify_matches=verify,
        TwoViewGeometryOptions=lambda: SimpleNamespace(ransac=SimpleNamespace(random_seed=-1)),
    )
    (tmp_path / "db").write_bytes(b"database")
    places = {f"k{i}": np.array([[5.0 + i, 6.0], [7.0, 8.0]], np.float32) for i in range(3)}
    more = {"pairs": np.array([[0, 1], [2, 1]]), "m0": np.array([[1, 0]], np.uint32), "m1": np.array([[0, 1]], np.uint32)}
    np.savez(tmp_path / "all.npz", **places, **more)
    ask = {"database": str(tmp_path / "db"), "learned": str(tmp_path / "all.npz"), "names": ["1.jpg", "2.jpg", "3.jpg"], "seed": 4}
    worker.add_learned(colmap, ask)
    assert written["path"] == ask["database"] == str(tmp_path / "db.learned") and (tmp_path / "db").read_bytes() == b"database"
    assert written[1].tolist() == [[9, 9, 9, 9], [5, 6, 1, 0], [7, 8, 1, 0]]
    assert written[2][2:].tolist() == [[6, 6, 1, 0, 0, 1], [7, 8, 1, 0, 0, 1]]  # behind the two of COLMAP
    assert written[1, 2] == [[0, 1], [1 + 1, 2 + 0]] and written[2, 3] == [[2 + 1, 0]] and len(written[3]) == 2
    assert written["pairs"] == ["1.jpg 2.jpg", "2.jpg 3.jpg"] and written["seed"] == 4


def test_the_smallest_features_are_left_out_where_two_photographs_have_enough_others(tmp_path, monkeypatch, capsys):
    """A photograph of this COLMAP has so many features of two orientations as its name says, twice as many with the smallest ones."""
    kept: dict[str, dict[str, int]] = {}

    class Database:
        def __init__(self, path):
            self.path = path

        def read_all_images(self):
            return [SimpleNamespace(name=name, image_id=name, camera_id=7) for name in kept.get(self.path, {})]

        def exists_descriptors(self, name):
            return True

        def read_keypoints(self, name):
            return np.repeat(np.arange(4.0 * kept[self.path][name]).reshape(-1, 4), 2, axis=0)

    class Opened(Database):
        @staticmethod
        @contextmanager
        def open(path):
            yield Database(path)

    def extract(database, images, names, *, extraction_options, **_):
        there = 1 if extraction_options.sift.first_octave == 0 else 2
        Path(database).touch()
        kept.setdefault(database, {}).update({name: there * int(name.split(".")[0].split("/")[-1]) for name in names})

    def made():
        return SimpleNamespace(sift=SimpleNamespace(max_num_features=8192, first_octave=-1))

    colmap = SimpleNamespace(
        FeatureExtractionOptions=made,
        ImageReaderOptions=SimpleNamespace,
        extract_features=extract,
        Database=Opened,
        CameraMode=SimpleNamespace(SINGLE=0),
        Device=SimpleNamespace(cpu=0),
    )
    ask = {"images": "", "masks": "", "camera_model": "OPENCV", "rig": None, "threads": 1, "max_side": 1600}
    rich, some = [f"{9000 + i}.jpg" for i in range(12)], [f"{4000 + i}.jpg" for i in range(12)]
    for case, (names, enough, large) in enumerate([(rich, None, True), (some, None, False), (some, 3000, True), (rich[:7], None, False)]):
        database = str(tmp_path / f"{case}.db")
        assert worker.extract_features(colmap, {**ask, "database": database, "groups": [names], "enough": enough}) is large
        assert set(kept[database]) == set(names)
        assert all(count == (1 if large else 2) * int(name.split(".")[0]) for name, count in kept[database].items())


@pytest.mark.parametrize(("angles", "wide"), [([4.0, 15.0, 3.0], True), ([4.0, 9.0, 14.0], False), ([], False)])
def test_the_first_pair_is_searched_with_half_of_the_angle_where_no_pair_has_all(angles, wide):
    """Pairs of 200, 199, ... inliers with these angles, and one of 40 inliers and 30 degrees, which is too weak to begin with."""
    count = len(angles) + 2
    told = [SimpleNamespace(inlier_matches=[0] * (200 - i), degrees=angle, tri_angle=-1.0) for i, angle in enumerate(angles)]
    weak = SimpleNamespace(inlier_matches=[0] * 40, degrees=30.0, tri_angle=-1.0)

    @contextmanager
    def open_database(path):
        yield SimpleNamespace(
            read_all_images=lambda: [SimpleNamespace(image_id=i, camera_id=1) for i in range(count)],
            read_all_cameras=lambda: [SimpleNamespace(camera_id=1)],
            read_two_view_geometries=lambda: (list(range(len(angles) + 1)), [*told, weak]),
            read_keypoints=lambda i: np.zeros((3, 6), np.float32),
        )

    def estimate(camera1, points1, camera2, points2, geometry):
        assert points1.shape == points2.shape == (3, 2)
        geometry.tri_angle = np.radians(geometry.degrees)
        return True

    colmap = SimpleNamespace(
        Database=SimpleNamespace(open=open_database),
        pair_id_to_image_pair=lambda key: (key, key + 1),
        estimate_two_view_geometry_pose=estimate,
    )
    mapper = SimpleNamespace(init_min_num_inliers=100, init_min_tri_angle=16.0)
    colmap.IncrementalPipelineOptions = lambda: SimpleNamespace(mapper=mapper)
    assert worker.has_wide_pair(colmap, {"database": ""}) is wide


@pytest.mark.parametrize(
    ("cameras", "posed", "errors", "kept"),
    [
        ([1] * 5, (5, 5), (0.31, 0.33), True),
        ([1, 1, 1, 2, 2], (5, 5), (0.31, 0.33), True),  # the other lens stays as it is
        ([1] * 5, (5, 4), (0.31, 0.33), False),  # fewer photographs fit
        ([1] * 5, (5, 5), (0.4, 1.9), False),  # the pixels are no squares
        ([1, 2, 2, 2, 2], (5,), (0.4,), None),  # one photograph says little of its lens
        ([2] * 5, (5,), (0.4,), None),
        ([], (0,), (0.0,), None),
    ],
)
def test_a_lens_with_two_focal_lengths_is_sought_again_with_one(tmp_path, monkeypatch, capsys, cameras, posed, errors, kept):
    """Camera 1 has two focal lengths, camera 2 has two that are nearly one; `cameras` are those of the photographs."""
    asked, updated = [], []
    lenses = {1: (2109.0, 834.2), 2: (600.0, 610.0)}

    def estimate(colmap, ask):
        i = len(asked)
        asked.append(ask)
        Path(ask["model"]).mkdir(parents=True)
        (Path(ask["model"]) / "cameras.bin").write_text(str(i))
        return {
            "registered": ["a"] * posed[i],
            "lacking": [],
            "mapper": "incremental",
            "mappers": {},
            "error": errors[i],
            "observations": 900.0,
        }

    @contextmanager
    def open_database(path):
        there = [SimpleNamespace(camera_id=i, width=288, height=360, has_prior_focal_length=False) for i in lenses]
        yield SimpleNamespace(read_all_cameras=lambda: there, update_camera=updated.append)

    def read_model(folder):
        found = {i: SimpleNamespace(model=SimpleNamespace(name="OPENCV"), params=[*lenses[i], 144.0, 180.0]) for i in lenses}
        return SimpleNamespace(cameras=found, images={i: SimpleNamespace(camera_id=camera) for i, camera in enumerate(cameras)})

    colmap = SimpleNamespace(Camera=SimpleNamespace, Database=SimpleNamespace(open=open_database), Reconstruction=read_model)
    colmap.ViewGraphCalibrationOptions, colmap.calibrate_view_graph = SimpleNamespace, lambda database, options: True
    monkeypatch.setattr(worker, "estimate_poses", estimate)
    monkeypatch.setattr(worker, "measure_angles", lambda model: 5.0)
    (tmp_path / "db").touch()
    names = {"maps": str(tmp_path / "maps"), "model": str(tmp_path / "model"), "database": str(tmp_path / "db")}
    found = worker.estimate_all(colmap, {**names, "mapper": "auto", "seed": 0, "stretched": 1.1, "narrow": False, "film": False})
    assert len(asked) == len(posed) and (tmp_path / "model" / "cameras.bin").read_text() == ("1" if kept else "0")
    assert found.get("one_focal_length", False) is bool(kept)
    if kept is not None:
        assert asked[1]["mapper"] == "global" and asked[1]["database"] != asked[0]["database"]
        assert [(new.camera_id, new.model, new.params) for new in updated] == [(1, "RADIAL", [834.2, 144.0, 180.0, 0.0, 0.0])]
        assert json.loads(capsys.readouterr().out.splitlines()[-1])["kept"] is kept


@pytest.mark.parametrize(
    ("posed", "errors", "mapper", "angle", "seen", "ran"),
    [
        ((10,), (0.3,), "auto", 4.1, 900.0, [("one", True)]),
        ((9,), (0.3,), "auto", 4.1, 900.0, [("one", True)]),
        ((8, 10), (0.3, 0.3), "auto", 4.1, 900.0, [("one", False), ("two", True)]),  # too few fit
        ((10, 10), (1.3, 1.2), "auto", 4.1, 900.0, [("one", True), ("two", False)]),  # two fit badly, too, and are stretched
        ((10, 10), (1.3, 0.4), "auto", 4.1, 900.0, [("one", False), ("two", True)]),
        ((10, 10), (0.1, 0.1), "auto", 1.6, 900.0, [("one", False), ("two", True)]),  # the camera only turns
        ((10, 10), (0.4, 0.1), "auto", 5.0, 5.0, [("one", False), ("two", True)]),  # the same, with five points
        (
            (10, 10),
            (0.3, 0.3),
            "incremental",
            4.1,
            900.0,
            [("two", False), ("one", True)],
        ),  # that one was asked for: only its lens may change
    ],
)
@pytest.mark.parametrize("film", [False, True])
def test_one_focal_length_first_for_videos_and_without_wide_angles(
    tmp_path, monkeypatch, capsys, posed, errors, mapper, angle, seen, ran, film
):
    asked = []
    monkeypatch.setattr(worker, "measure_angles", lambda model: angle)

    def estimate(colmap, ask):
        i = len(asked)
        asked.append("one" if ask["database"].endswith(".one") else "two")
        assert ask["mapper"] == ("global" if asked[i] == "one" else mapper)
        Path(ask["model"]).mkdir(parents=True)
        (Path(ask["model"]) / "cameras.bin").write_text(asked[i])
        return {"registered": ["a"] * posed[i], "lacking": [], "mappers": {asked[i]: posed[i]}, "error": errors[i], "observations": seen}

    def read_model(folder):
        lens = SimpleNamespace(model=SimpleNamespace(name="OPENCV"), params=[2109.0, 834.2, 144.0, 180.0])
        return SimpleNamespace(cameras={1: lens}, images={i: SimpleNamespace(camera_id=1) for i in range(10)})

    @contextmanager
    def open_database(path):
        cameras = [SimpleNamespace(camera_id=1, model=SimpleNamespace(name="OPENCV"), params=[432.0, 440.0], width=288, height=360)]
        yield SimpleNamespace(read_all_cameras=lambda: cameras)

    firsts = []
    monkeypatch.setattr(worker, "estimate_poses", estimate)
    monkeypatch.setattr(worker, "use_one_focal_length", lambda colmap, database, focal: firsts.append(focal))
    (tmp_path / "db").touch()
    names = {"maps": str(tmp_path / "maps"), "model": str(tmp_path / "model"), "database": str(tmp_path / "db")}
    ask = {**names, "mapper": mapper, "seed": 3, "stretched": 1.1, "narrow": not film, "film": film, "groups": [["a"] * 6, ["b"] * 4]}
    colmap = SimpleNamespace(Database=SimpleNamespace(open=open_database), Reconstruction=read_model)
    colmap.ViewGraphCalibrationOptions, calibrated = SimpleNamespace, []
    colmap.calibrate_view_graph = lambda database, options: calibrated.append((database, options.random_seed))
    found = worker.estimate_all(colmap, ask)
    assert calibrated == [(names["database"] + ".one", 3)]
    assert asked == [name for name, _ in ran] and firsts == [{1: 432.0 if mapper == "auto" else 834.2}]
    kept = next(name for name, stays in ran if stays)
    assert found.get("one_focal_length", False) is (kept == "one") and (tmp_path / "model" / "cameras.bin").read_text() == kept
    assert ('"one first"' in capsys.readouterr().out) is (mapper == "auto")


def test_the_angles_from_which_the_points_of_a_model_are_seen():
    centres = {1: [0.0, 0.0, 0.0], 2: [1.0, 0.0, 0.0], 3: [0.1, 0.0, 0.0]}
    images = {i: SimpleNamespace(has_pose=True, projection_center=lambda at=at: np.array(at)) for i, at in centres.items()}

    def point(z, *seen):
        return SimpleNamespace(xyz=np.array([0.0, 0.0, z]), track=SimpleNamespace(elements=[SimpleNamespace(image_id=i) for i in seen]))

    points = {5: point(1.0, 1, 2, 3), 7: point(1.0, 1, 3), 9: point(50.0, 1, 2)}  # 45, 5.7 and 1.1 degrees
    model = SimpleNamespace(images=images, points3D=points)
    assert worker.measure_angles(model) == pytest.approx(np.degrees(np.arctan(0.1)))
    assert worker.measure_angles(SimpleNamespace(images=images, points3D={})) == 0.0
