"""Re-ranking as a user would assemble it today, on the data of `benches/rerank.rs`.

Matching: numpy GEMM + argmax both ways. Verification: OpenCV's RANSAC and USAC_MAGSAC. Tolerance 21 px, at most 2000
iterations, confidence 0.995, as ours. Prints milliseconds for 100 candidates (candidates over 2 threads for OpenCV,
BLAS's own threads for numpy) and the inliers found, next to ours on the same matches.

    pip install numpy==2.4.6 opencv-python-headless==5.0.0.93 safetensors==0.8.0
    PLACEFORMER_BENCH_EXPORT=DIR cargo bench --bench rerank
    python benches/peers/rerank_opencv.py DIR
"""
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from safetensors.numpy import load_file

UNIONS = {"s11": (0, 400), "s12": (0, 600), "s23": (400, 650)}
TOLERANCE, ITERATIONS, CONFIDENCE, THREADS = 21.0, 2000, 0.995, 2


def mutual(query, reference):
    similarity = query @ reference.T
    forth, back = similarity.argmax(1), similarity.argmax(0)
    rows = np.arange(len(query))
    keep = back[forth] == rows
    return rows[keep], forth[keep]


def match(descriptors, centres):
    problems = []
    for candidate in range(1, len(descriptors)):
        for start, end in UNIONS.values():
            i, j = mutual(descriptors[0, start:end], descriptors[candidate, start:end])
            problems.append((centres[0, start:end][i], centres[candidate, start:end][j]))
    return problems


def verify(problem, method):
    query, reference = problem
    if len(query) < 4:
        return 0
    homography, mask = cv2.findHomography(query, reference, method, TOLERANCE, maxIters=ITERATIONS, confidence=CONFIDENCE)
    return 0 if homography is None else int(mask.sum())


def timed(work, repeats):
    best, cpu = np.inf, np.inf
    for _ in range(repeats):
        start, cpu_start = time.perf_counter(), time.process_time()
        result = work()
        best, cpu = min(best, time.perf_counter() - start), min(cpu, time.process_time() - cpu_start)
    return f"{best * 1e3:.0f} ms (CPU {cpu * 1e3:.0f})", result


def main(directory):
    print("numpy", np.__version__, "OpenCV", cv2.__version__)
    cv2.setNumThreads(1)
    pool = ThreadPoolExecutor(THREADS)
    for percent in (40, 15, 0):
        data = load_file(f"{directory}/rerank_{percent}.safetensors")
        ours = data["ours_matches_inliers"].reshape(-1, 2)
        milliseconds, problems = timed(lambda: match(data["descriptors"], data["centres"]), 3)
        matches = np.array([len(query) for query, _ in problems])
        print(f"{percent}%: numpy matching {milliseconds}, {matches.sum()} matches (ours {int(ours[:, 0].sum())})")
        same = matches == ours[:, 0]
        for name, repeats in (("RANSAC", 1), ("USAC_MAGSAC", 3)):
            work = lambda: list(pool.map(lambda p: verify(p, getattr(cv2, name)), problems, chunksize=10))
            milliseconds, inliers = timed(work, repeats)
            inliers = np.array(inliers)
            print(
                f"    {name}: {milliseconds}; inliers {inliers[same].mean():.2f}, ours {ours[same, 1].mean():.2f}"
                f" (mean over {same.sum()} problems with as many matches)"
            )


main(sys.argv[1])
