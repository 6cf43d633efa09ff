#!/usr/bin/env python3
"""Lays out photographs and drawn towns as one data set with mapped and unmapped places.

    calibration_data.py OUT --drives DIR --town DIR [--town DIR ...] --stranger DIR

A calibration is fitted on it. DRIVES holds one folder of frames per drive, named by their number in
a video of 30 frames a second. Parts denser than a frame a second are thinned. Along each drive,
stretches that are mapped alternate with stretches that are not. Frames within 15 of each other show
the same place and frames farther apart do not, so the gaps of 15 frames belong to neither.

Towns come from `placeformer synth`. Of the stranger only the queries are used, as places that nobody
mapped. OUT gets database/ and queries/ (links), and ground_truth.csv, where an empty reference says
that the query has no match.
"""

import argparse
import csv
import re
from pathlib import Path

FRAMES_APART = 29
SAME_PLACE = 15
MAPPED, UNMAPPED = 45, 25
PERIOD = MAPPED + SAME_PLACE + UNMAPPED + SAME_PLACE
# Every third frame of a mapped stretch is a reference, the others are queries one or two seconds away.
STEP = 3


class Layout:
    def __init__(self, out):
        self.out, self.rows = out, []

    def link(self, side, name, source):
        target = self.out / side / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(source.resolve())

    def query(self, name, source, positives):
        self.link("queries", name, source)
        self.rows += [(name, reference) for reference in positives or [""]]

    def write_truth(self):
        with open(self.out / "ground_truth.csv", "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(("query", "reference"))
            writer.writerows(self.rows)

    def counts(self):
        unknown = sum(1 for _, reference in self.rows if not reference)
        known = len({query for query, reference in self.rows if reference})
        return f"{known} queries of mapped places, {unknown} of others"


def thinned(frames):
    kept, last = [], None
    for frame in sorted(frames):
        number = int(re.sub(r"\D", "", frame.stem))
        if last is None or number - last >= FRAMES_APART:
            kept.append(frame)
            last = number
    return kept


def add_drive(layout, folder):
    frames = thinned(folder.glob("*.jpg"))
    name = {at: f"{folder.name}/{frame.name}" for at, frame in enumerate(frames)}
    references = [at for at in name if at % PERIOD < MAPPED and at % STEP == 0]
    for at in references:
        layout.link("database", name[at], frames[at])
    for at in name:
        near = [other for other in references if abs(at - other) <= SAME_PLACE]
        if at not in references and (not near or at % PERIOD < MAPPED):
            layout.query(name[at], frames[at], [name[other] for other in near])


def add_town(layout, folder):
    for photo in sorted((folder / "database").iterdir()):
        layout.link("database", f"{folder.name}/{photo.name}", photo)
    positives = {}
    with open(folder / "ground_truth.csv", newline="") as file:
        for row in csv.DictReader(file):
            found = positives.setdefault(row["query"], [])
            if row["reference"]:
                found.append(f"{folder.name}/{row['reference']}")
    for query, found in positives.items():
        layout.query(f"{folder.name}/{query}", folder / "queries" / query, found)


def add_stranger(layout, folder):
    for photo in sorted((folder / "queries").iterdir()):
        layout.query(f"{folder.name}/{photo.name}", photo, [])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--drives", type=Path, required=True)
    parser.add_argument("--town", type=Path, action="append", default=[])
    parser.add_argument("--stranger", type=Path, action="append", default=[])
    args = parser.parse_args()
    layout = Layout(args.out)
    for folder in sorted(path for path in args.drives.iterdir() if path.is_dir()):
        add_drive(layout, folder)
    for folder in args.town:
        add_town(layout, folder)
    for folder in args.stranger:
        add_stranger(layout, folder)
    layout.write_truth()
    print(f"{args.out}: {layout.counts()}")


if __name__ == "__main__":
    main()
