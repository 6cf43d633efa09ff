"""Inliers that OpenCV's RANSAC finds among our matches of real photographs: writes the fixture of a test.

    pip install numpy==2.4.6 opencv-python-headless==5.0.0.93
    cargo build --release
    python benches/peers/verify_opencv.py target/release/placeformer DATASET tests/golden/cmu_matches.json

DATASET is a folder with `queries`, `database` and `ground_truth.csv` (CMU Seasons, park slice: April and October). Of
every fourth query, the first accepted reference and one from another part of the drive are matched. Tolerance 21 px, at
most 2000 iterations, confidence 0.995, as ours. The file holds positions of matches in quarters of a patch (3.5 px), of
which all centres are multiples, and no part of the photographs.
"""
import csv
import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np

EVERY, UNIT = 4, 3.5
TOLERANCE, ITERATIONS, CONFIDENCE = 21.0, 2000, 0.995


def opencv_inliers(points):
    if len(points) < 4:
        return 0
    pixels = np.array(points, dtype=np.float32) * np.float32(UNIT)
    homography, mask = cv2.findHomography(
        pixels[:, :2], pixels[:, 2:], cv2.RANSAC, TOLERANCE, maxIters=ITERATIONS, confidence=CONFIDENCE
    )
    return 0 if homography is None else int(mask.sum())


def problems(program, root, query, reference):
    command = [program, "match", "--json", root / "queries" / query, root / "database" / reference]
    for combination in json.loads(subprocess.run(command, check=True, capture_output=True).stdout)["combinations"]:
        pairs = [pair["query"] + pair["reference"] for pair in combination["correspondences"]]
        points = [[round(value / UNIT) for value in pair] for pair in pairs]
        assert all(value * UNIT == exact for p, pair in zip(points, pairs) for value, exact in zip(p, pair))
        yield combination["score"], points


def main(program, root, out):
    root = Path(root)
    accepted = {}
    with open(root / "ground_truth.csv", newline="") as file:
        for row in csv.DictReader(file):
            accepted.setdefault(row["query"], []).append(row["reference"])
    database = sorted(path.name for path in (root / "database").iterdir())
    found = []
    for number, query in enumerate(sorted(accepted)[::EVERY]):
        first = accepted[query][0]
        elsewhere = database[(database.index(first) + len(database) // 2) % len(database)]
        for same_place, reference in ((True, first), (False, elsewhere)):
            for score, points in problems(program, root, query, reference):
                found.append(
                    {
                        "query": number,
                        "same_place": same_place,
                        "score": score,
                        "opencv_inliers": opencv_inliers(points),
                        "points": [value for point in points for value in point],
                    }
                )
    head = {"opencv": cv2.__version__, "unit_px": UNIT, "tolerance_px": TOLERANCE}
    lines = ",\n".join(json.dumps(problem, separators=(",", ":")) for problem in found)
    Path(out).write_text(json.dumps(head)[:-1] + ', "problems": [\n' + lines + "\n]}\n")
    print(len(found), "problems,", sum(problem["opencv_inliers"] for problem in found), "inliers by OpenCV")


main(*sys.argv[1:])
