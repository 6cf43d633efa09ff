"""The whole query as a user would assemble it today: OpenCV, OpenVINO, faiss, numpy, OpenCV.

Decodes a JPEG and resizes it (OpenCV, linear), runs the truncated backbone (OpenVINO, bf16 where the CPU has it),
projects the mean token with the same head, finds the nearest 100 of all references (faiss, half precision), reads their
key patches (one f16 file each), matches them (numpy, mutual nearest neighbours over the three scale combinations),
verifies them (OpenCV, USAC_MAGSAC) and ranks by the inliers. There is no HTTP in between, no checksum and no deadline.

    pip install -r benches/peers/requirements.txt
    placeformer bench --end-to-end --peers PYTHON

The second command draws the photos, runs this file next to its own measurement, and reads the JSON object that this
file prints.
"""

import argparse
import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import faiss
import numpy as np
from decode_opencv import tensor
from extract_openvino import HEADS, PATCH, build, fused_names, openvino_runner
from safetensors.numpy import load_file

CAPS, COMBINATIONS, CANDIDATES = (400, 200, 50), ((0,), (0, 1), (1, 2)), 100
TOLERANCE, ITERATIONS, CONFIDENCE = 1.5 * PATCH, 2000, 0.995


def pool(values, kernel):
    """Means of [rows, columns, d] over kernel x kernel windows side by side."""
    rows, columns = (side // kernel * kernel for side in values.shape[:2])
    windows = values[:rows, :columns].reshape(rows // kernel, kernel, columns // kernel, kernel, -1)
    return windows.mean((1, 3))


def unit(values):
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


class Pipeline:
    def __init__(self, arguments):
        self.columns, self.rows = (int(side) // PATCH for side in arguments.size.split("x"))
        model = build(fused_names(load_file(arguments.weights)), self.columns, self.rows, arguments.exit_block)
        self.infer = openvino_runner(model, arguments.threads, "bf16")
        head = load_file(arguments.head)
        self.weight, self.bias = head["weight"], head["bias"]
        self.patches = Path(arguments.work)
        self.pool = ThreadPoolExecutor(arguments.threads)
        self.index, self.drawn = None, 0

    def decode(self, photo):
        size = (self.columns * PATCH, self.rows * PATCH)
        return tensor(np.frombuffer(photo, np.uint8), size, cv2.INTER_LINEAR)[None]

    def extract(self, pixels):
        tokens, attention = self.infer(pixels)
        tokens = tokens[0, 1:]
        descriptor = unit(unit(tokens.mean(0)) @ self.weight.T + self.bias)
        grid = tokens.reshape(self.rows, self.columns, -1)
        level = attention[0].sum(0).reshape(self.rows, self.columns, 1) * (self.rows * self.columns / HEADS)
        descriptors, centres = [], []
        for kernel, cap in zip((1, 2, 3), CAPS):
            strength = pool(level, kernel)[..., 0]
            chosen = np.argsort(-strength, axis=None, kind="stable")[:cap]
            chosen = chosen[strength.ravel()[chosen] > 1]
            descriptors.append(unit(pool(grid, kernel).reshape(strength.size, -1)[chosen]))
            y, x = np.divmod(chosen, strength.shape[1])
            centres.append((np.stack([x, y], 1) + 0.5).astype(np.float32) * kernel * PATCH)
        return descriptor.astype(np.float32)[None], descriptors, centres

    def store(self, photos, references):
        """Describes `photos`; fills the index up with random vectors, whose patches are those of the photos in turn."""
        found = []
        for number, photo in enumerate(photos):
            descriptor, descriptors, centres = self.extract(self.decode(photo))
            found.append(descriptor)
            values = {f"d{scale}": value.astype(np.float16) for scale, value in enumerate(descriptors)}
            np.savez(self.patches / f"{number}.npz", **values, **{f"c{s}": value for s, value in enumerate(centres)})
        self.drawn = len(photos)
        self.index = faiss.IndexScalarQuantizer(256, faiss.ScalarQuantizer.QT_fp16, faiss.METRIC_L2)
        self.index.add(np.concatenate(found))
        generator = np.random.default_rng(1)
        while self.index.ntotal < references:
            count = min(100_000, references - self.index.ntotal)
            self.index.add(unit(generator.standard_normal((count, 256), dtype=np.float32)))

    def load(self, number):
        with np.load(self.patches / f"{number % self.drawn}.npz") as file:
            return [file[f"d{s}"].astype(np.float32) for s in range(3)], [file[f"c{s}"] for s in range(3)]

    def score(self, query, reference):
        inliers = 0
        for scales in COMBINATIONS:
            (a, at), (b, bt) = ([np.concatenate([part[s] for s in scales]) for part in side] for side in (query, reference))
            similarity = a @ b.T
            forth, back = similarity.argmax(1), similarity.argmax(0)
            kept = np.flatnonzero(back[forth] == np.arange(len(a)))
            if len(kept) < 4:
                continue
            found = cv2.findHomography(
                at[kept], bt[forth[kept]], cv2.USAC_MAGSAC, TOLERANCE, maxIters=ITERATIONS, confidence=CONFIDENCE
            )
            inliers += 0 if found[0] is None else int(found[1].sum())
        return inliers

    def query(self, photo):
        """Candidates by falling score, and seconds per stage."""
        marks = [time.perf_counter()]
        mark = lambda: marks.append(time.perf_counter())
        pixels = self.decode(photo)
        mark()
        descriptor, descriptors, centres = self.extract(pixels)
        mark()
        candidates = self.index.search(descriptor, CANDIDATES)[1][0]
        mark()
        references = list(self.pool.map(self.load, candidates))
        mark()
        scores = list(self.pool.map(lambda reference: self.score((descriptors, centres), reference), references))
        ranked = [candidate for _, candidate in sorted(zip(scores, candidates), key=lambda pair: -pair[0])]
        mark()
        return ranked, dict(zip(("decode", "extract", "search", "load", "rerank"), np.diff(marks)))


def peak_resident_bytes():
    """Not getrusage's ru_maxrss: that begins with the memory of whoever started this process."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmHWM:"))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", required=True)
    parser.add_argument("--head", required=True)
    parser.add_argument("--photos", required=True, help="folder with references/*.jpg and queries/*.jpg")
    parser.add_argument("--work", required=True, help="folder for key patches")
    parser.add_argument("--references", type=int, required=True)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--size", default="448x336")
    parser.add_argument("--exit-block", type=int, default=8)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    arguments = parser.parse_args()
    faiss.omp_set_num_threads(arguments.threads)
    cv2.setNumThreads(1)
    read = lambda kind: [path.read_bytes() for path in sorted((Path(arguments.photos) / kind).glob("*.jpg"))]
    pipeline = Pipeline(arguments)
    pipeline.store(read("references"), arguments.references)
    queries = read("queries")
    for photo in queries[:2]:
        pipeline.query(photo)
    total, stages, until = [], [], time.perf_counter() + arguments.seconds
    while time.perf_counter() < until:
        started = time.perf_counter()
        stages.append(pipeline.query(queries[len(total) % len(queries)])[1])
        total.append(time.perf_counter() - started)
    milliseconds = lambda values, percentile: round(float(np.percentile(values, percentile)) * 1e3, 3)
    result = {
        "queries": len(total),
        "p50_ms": milliseconds(total, 50),
        "p99_ms": milliseconds(total, 99),
        "queries_per_second": round(len(total) / sum(total), 3),
        "stages_ms": {stage: milliseconds([times[stage] for times in stages], 50) for stage in stages[0]},
        "resident_bytes": peak_resident_bytes(),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
