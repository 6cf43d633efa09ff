// Where a map has holes: gaps between stretches of references, and places that were photographed
// one way only.
//
// There is no map of streets to compare with, and photos come in any order. So a gap is defined by
// the references alone: within a stretch, each is near to another (within `NEAR`, the distance at
// which two photos count as one place); where two stretches come closer to each other than `FAR`,
// somebody probably drove from one to the other, and what lies between is a gap.

import { Grid, angleBetween, distance } from "./geometry.js";

/** Metres within which two photos show the same place. */
export const NEAR = 25;

/** Metres beyond which two stretches have nothing to do with each other. */
export const FAR = 200;

/** Metres within which one photo stands for all, where gaps are looked for. */
const THIN = 10;

/** Degrees by which two cameras may differ that look the same way. */
const SAME_WAY = 60;

/**
 * The coverage of points `{at: [x, y], heading}` (the heading may be null):
 * `stretches` is the number of stretches, `gaps` are `{from, to, length}` with indices of points,
 * the longest first, and `oneWay` the indices of points from whose place nobody looked back.
 */
export function coverageOf(points) {
  const grid = new Grid(
    points.map((point) => point.at),
    NEAR,
  );
  const stretches = joinNear(points, grid);
  const gaps = gapsBetween(points, stretches);
  return {
    stretches: new Set(points.map((_, index) => stretches.find(index))).size,
    gaps: gaps.sort((one, other) => other.length - one.length),
    oneWay: oneWayPlaces(points, grid),
    withHeading: points.filter((point) => point.heading !== null).length,
  };
}

/** Sets of points that are connected, with the usual union and find. */
class Sets {
  constructor(size) {
    this.parents = Int32Array.from({ length: size }, (_, index) => index);
  }

  find(index) {
    let root = index;
    while (this.parents[root] !== root) {
      root = this.parents[root];
    }
    while (this.parents[index] !== root) {
      [this.parents[index], index] = [root, this.parents[index]];
    }
    return root;
  }

  /** Joins two sets; false if they were one. */
  join(one, other) {
    const [a, b] = [this.find(one), this.find(other)];
    this.parents[a] = b;
    return a !== b;
  }

  copy() {
    const copied = new Sets(0);
    copied.parents = this.parents.slice();
    return copied;
  }
}

function joinNear(points, grid) {
  const sets = new Sets(points.length);
  points.forEach((point, index) => {
    for (const other of grid.within(point.at, NEAR)) {
      sets.join(index, other);
    }
  });
  return sets;
}

/**
 * The shortest ways that connect the stretches, none of them twice: Kruskal's spanning tree over
 * the pairs of points of different stretches.
 */
function gapsBetween(points, stretches) {
  const few = thinned(points);
  const grid = new Grid(
    few.map((index) => points[index].at),
    FAR / 2,
  );
  const candidates = few.flatMap((index) => nearestOfOthers(points, few, grid, stretches, index));
  candidates.sort((one, other) => one.length - other.length);
  const connected = stretches.copy();
  return candidates.filter(({ from, to }) => connected.join(from, to));
}

/** One point of each small cell. All in a cell are of one stretch, because they are near. */
function thinned(points) {
  const cells = new Grid(
    points.map((point) => point.at),
    THIN,
  ).cells;
  return [...cells.values()].map((indices) => indices[0]);
}

/** The way from a point to the nearest of each other stretch within `FAR`. */
function nearestOfOthers(points, few, grid, stretches, from) {
  const own = stretches.find(from);
  const nearest = new Map();
  for (const found of grid.within(points[from].at, FAR)) {
    const to = few[found];
    const stretch = stretches.find(to);
    const length = distance(points[from].at, points[to].at);
    // Each pair is seen from both ends; one is enough.
    if (to > from && stretch !== own && length < (nearest.get(stretch)?.length ?? Infinity)) {
      nearest.set(stretch, { from, to, length });
    }
  }
  return [...nearest.values()];
}

function oneWayPlaces(points, grid) {
  const found = [];
  points.forEach((point, index) => {
    if (point.heading === null) {
      return;
    }
    const back = (point.heading + 180) % 360;
    for (const other of grid.within(point.at, NEAR)) {
      const { heading } = points[other];
      if (heading !== null && angleBetween(heading, back) <= SAME_WAY) {
        return;
      }
    }
    found.push(index);
  });
  return found;
}
