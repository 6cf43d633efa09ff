"""From a JPEG to the model's tensor with OpenCV: its linear resizing (not antialiased) and its areal one (antialiased).

    pip install -r benches/peers/requirements.txt
    PLACEFORMER_BENCH_JPEG=FILE cargo bench --bench decode
    python benches/peers/decode_opencv.py FILE [--size 448x336] [--threads 2]

Both measure the same file; ours is antialiased. Prints one JSON object: milliseconds, median and least, and the CPU
time of all threads, for pixels (decoded and resized) and for the tensor (also normalised, a plane for each colour).
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from timing import measure

MEAN = np.array([0.485, 0.456, 0.406], np.float32)
DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)


def pixels(photo, size, interpolation):
    return cv2.resize(cv2.imdecode(photo, cv2.IMREAD_COLOR_RGB), size, interpolation=interpolation)


def tensor(photo, size, interpolation):
    image = (pixels(photo, size, interpolation).astype(np.float32) / 255 - MEAN) / DEVIATION
    return np.ascontiguousarray(image.transpose(2, 0, 1))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photo", type=Path)
    parser.add_argument("--size", default="448x336")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repetitions", type=int, default=50)
    arguments = parser.parse_args()
    cv2.setNumThreads(arguments.threads)
    size = tuple(map(int, arguments.size.split("x")))
    photo = np.frombuffer(arguments.photo.read_bytes(), np.uint8)
    results = {
        f"{name}-{step.__name__}": measure(
            lambda photos: step(photos[0], size, interpolation), [photo], arguments.repetitions
        )
        for name, interpolation in (("linear", cv2.INTER_LINEAR), ("area", cv2.INTER_AREA))
        for step in (pixels, tensor)
    }
    print(json.dumps({"opencv": cv2.__version__, **results}, indent=1))


if __name__ == "__main__":
    main()
