#!/usr/bin/env python3
"""Chooses among heads by their recall on held-out places, and writes down how.

    select_head.py RESULTS --heads DIR --sets NAME ... --baseline NAME --table FILE --winner FILE

RESULTS holds what `placeformer eval --json` wrote, one NAME-of-head.NAME-of-set.json for each head and
set, and DIR holds the heads by name. The score of a head is the mean of R@1 and R@10 before
re-ranking, averaged over the sets with equal weight. A paired bootstrap over queries says whether the
best head leads another by more than noise.

The best head and those that it does not lead by more than noise are level. Among them the smallest
stored vector wins. Among equally small ones the mean wins, because existing maps can take it without
their images. Then the score decides. The baseline is shown and never chosen.
"""

import argparse
import json
import random
import shutil
import textwrap
from pathlib import Path

RESAMPLES, SEED = 2000, 0
STAGES = ("global", "reranked")


class Result:
    """One head on one set."""

    def __init__(self, path):
        summary = json.loads(path.read_text())
        self.recall = {stage: summary["recall"][stage] for stage in STAGES}
        self.pooled_bytes = summary["bytes"]["pooled"]
        self.model = summary["config"]["model"]
        judged = sorted((o for o in summary["outcomes"] if o["positives"] > 0), key=lambda outcome: outcome["query"])
        self.queries = [outcome["query"] for outcome in judged]
        self.points = [points(outcome["global_rank"]) for outcome in judged]
        if not judged:
            raise SystemExit(f"{path}: no query has a match")

    def is_mean(self):
        """A model's identity names the pooling where it is not the mean."""
        return not any(part.startswith(("gem", "vlad")) for part in self.model.split(":"))

    def score(self, stage):
        return (self.recall[stage]["1"] + self.recall[stage]["10"]) / 2


def points(rank):
    """What a query adds to the mean of R@1 and R@10, in percent."""
    return 0 if rank is None else 50 * (rank <= 1) + 50 * (rank <= 10)


def mean(values):
    values = list(values)
    return sum(values) / len(values)


def lead(best, other, sets):
    """95% interval of the difference of two scores."""
    rng, differences = random.Random(SEED), []
    pairs = []
    for name in sets:
        if best[name].queries != other[name].queries:
            raise SystemExit(f"{name}: two heads were asked different queries")
        pairs.append([a - b for a, b in zip(best[name].points, other[name].points)])
    for _ in range(RESAMPLES):
        differences.append(mean(mean(rng.choices(pair, k=len(pair))) for pair in pairs))
    differences.sort()
    return differences[int(0.025 * RESAMPLES)], differences[int(0.975 * RESAMPLES) - 1]


def choose(heads, sets):
    """The winner, the one with the highest score, and for each other head the interval of that one's lead."""
    score = {name: mean(results[s].score("global") for s in sets) for name, results in heads.items()}
    best = min(heads, key=lambda name: (-score[name], name))
    leads = {name: lead(heads[best], heads[name], sets) for name in heads if name != best}
    level = [best] + [name for name, (low, _) in leads.items() if low <= 0]
    size = {name: heads[name][sets[0]].pooled_bytes for name in heads}
    winner = min(level, key=lambda name: (size[name], not heads[name][sets[0]].is_mean(), -score[name], name))
    return winner, best, leads


def table(heads, sets, leads, best):
    head = ["head", "stored vector"]
    head += [f"{s}, R@1 / R@10" for s in sets] + ["score"] + [f"{s}, re-ranked" for s in sets] + ["score, re-ranked"]
    head += ["behind the best (95%)"]
    rows = [head, ["---"] * len(head)]
    for name, results in heads.items():
        both = lambda s, stage: "{:.1f} / {:.1f}".format(results[s].recall[stage]["1"], results[s].recall[stage]["10"])
        row = [name, f"{results[sets[0]].pooled_bytes / 1000:.1f} kB"]
        for stage in STAGES:
            row += [both(s, stage) for s in sets] + [f"{mean(results[s].score(stage) for s in sets):.1f}"]
        behind = "best" if name == best else "{:.1f} to {:.1f}".format(*leads[name]) if name in leads else ""
        rows.append(row + [behind])
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def bullet(text):
    return textwrap.fill(f"- {text}", 99, subsequent_indent="  ", break_on_hyphens=False)


def explain(heads, baseline, sets, data):
    winner, best, leads = choose(heads, sets)
    size = heads[winner][sets[0]].pooled_bytes
    ahead = f"`{best}` has the highest score, but leads `{winner}` by no more than noise"
    if winner == best:
        reason = f"`{winner}` has the highest score"
        reason += " of those that noise leaves level." if any(low <= 0 for low, _ in leads.values()) else "."
    elif size < heads[best][sets[0]].pooled_bytes:
        more = heads[best][sets[0]].pooled_bytes
        reason = f"{ahead}, and a reference keeps {more / 1000:.1f} kB with it instead of {size / 1000:.1f} kB."
    else:
        reason = f"{ahead}, and existing maps, which keep means, can take the latter without their images."
    counts = ", ".join(f"{len(heads[winner][s].queries)} queries in {s}" for s in sets)
    text = f"""# How the default head was chosen

Written by `make head`; do not edit. Recalls are in percent, on held-out places:
{counts}.

{table({**baseline, **heads}, sets, leads, best)}

**Chosen: {winner}.** {reason}

- The score is the mean of R@1 and R@10 before re-ranking, averaged over the sets. A head affects
  re-ranking only through the candidates that it finds, so the re-ranked columns are shown and do
  not decide.
- The last column is the 95% interval of the best head's lead in score, by a paired bootstrap over
  queries ({RESAMPLES} resamples). A head whose interval reaches 0 counts as level with the best.
  Among level heads the smallest stored vector wins, because each reference keeps its pooled tokens
  for the next head: 12.3 kB with a VLAD, next to about 117 kB of key patches, and applying the head
  costs sixteen times as much. Among equally small ones the mean wins, because existing maps keep
  means and can take it without their images. Then the score decides.
{bullet(data)}
- No indoor set is at hand, so nothing here says how the heads do inside buildings.
- The sets on which recall is reported (CMU Seasons, Fordham) were not used.
"""
    return winner, text


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path)
    parser.add_argument("--heads", type=Path, required=True)
    parser.add_argument("--sets", nargs="+", required=True)
    parser.add_argument("--baseline", required=True)
    parser.add_argument("--data", default="", help="a sentence on what the heads were made from and chosen by")
    parser.add_argument("--table", type=Path, required=True)
    parser.add_argument("--winner", type=Path, required=True)
    args = parser.parse_args()
    read = lambda name: {s: Result(args.results / f"{name}.{s}.json") for s in args.sets}
    heads = {path.stem: read(path.stem) for path in sorted(args.heads.glob("*.safetensors"))}
    if not heads:
        raise SystemExit(f"{args.heads} holds no heads")
    winner, text = explain(heads, {args.baseline: read(args.baseline)}, args.sets, args.data)
    args.table.write_text(text)
    shutil.copyfile(args.heads / f"{winner}.safetensors", args.winner)
    print(text)
    print(f"{args.winner} is now {winner}. Its calibration is another one: run `make calibration` next.")


if __name__ == "__main__":
    main()
