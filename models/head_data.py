#!/usr/bin/env python3
"""Divides photographs and drawn towns by place: some to make heads from, others to choose among them.

    head_data.py OUT --drives DIR --town DIR ... --distractor DIR ...

DRIVES holds one folder of frames per drive, named by their number in a video of 30 frames a second.
Parts denser than a frame a second are thinned. Along each drive, stretches to learn from alternate
with stretches that are held out. Frames of the gaps between them are in neither.

OUT/train/ gets a folder of links for each stretch to learn from. OUT/drives/ and OUT/towns/ are data
sets of held-out places, with database/, queries/ and ground_truth.csv.

In the drives, every sixth held-out frame is a reference. Only references within three frames of a
query are right; its other neighbours, a few seconds away, are wrong. Every third frame of the
stretches to learn from is a reference, too. No query shows its place, so it reveals nothing about
the places that queries show.

The towns come from `placeformer synth`. Of distractors only the database is used, as places that are
mapped and that no query shows.
"""

import argparse
from pathlib import Path

from calibration_data import SAME_PLACE, Layout, add_town, thinned

LEARNT, HELD_OUT = 60, 40
PERIOD = LEARNT + SAME_PLACE + HELD_OUT + SAME_PLACE
STEP, RIGHT, LEARNT_STEP = 6, 3, 3


def is_held_out(at):
    return LEARNT + SAME_PLACE <= at % PERIOD < LEARNT + SAME_PLACE + HELD_OUT


def divide(folder, train, held_out):
    frames = thinned(folder.glob("*.jpg"))
    names = [f"{folder.name}/{frame.name}" for frame in frames]
    references = [at for at in range(len(frames)) if is_held_out(at) and at % STEP == 0]
    for at in references:
        held_out.link("database", names[at], frames[at])
    for at, frame in enumerate(frames):
        if at % PERIOD < LEARNT:
            train.link(f"{folder.name}-{at // PERIOD}", frame.name, frame)
            if at % LEARNT_STEP == 0:
                held_out.link("database", names[at], frame)
        elif is_held_out(at) and at not in references:
            near = [names[other] for other in references if abs(at - other) <= RIGHT and at // PERIOD == other // PERIOD]
            if near:
                held_out.query(names[at], frame, near)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--drives", type=Path, required=True)
    parser.add_argument("--town", type=Path, action="append", default=[])
    parser.add_argument("--distractor", type=Path, action="append", default=[])
    args = parser.parse_args()
    train, drives, towns = (Layout(args.out / name) for name in ("train", "drives", "towns"))
    folders = sorted(path for path in args.drives.iterdir() if path.is_dir())
    if not any(any(folder.glob("*.jpg")) for folder in folders):
        raise SystemExit(f"{args.drives} holds no folders of *.jpg frames")
    for folder in folders:
        divide(folder, train, drives)
    for folder in args.town:
        add_town(towns, folder)
    for folder in args.distractor:
        for photo in sorted((folder / "database").iterdir()):
            towns.link("database", f"{folder.name}/{photo.name}", photo)
    for layout in (drives, towns):
        layout.write_truth()
        print(f"{layout.out}: {layout.counts()}")


if __name__ == "__main__":
    main()
