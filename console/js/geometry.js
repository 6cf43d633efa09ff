// Positions on the ground in metres, as far as a town needs it.

const METRES_PER_DEGREE = 111_320;

/** Puts the origin at a position and gives the functions between degrees and metres. */
export function planeAround(origin) {
  // Degrees of longitude shrink towards the poles.
  const shrink = Math.max(0.01, Math.cos((origin.lat * Math.PI) / 180));
  return {
    /** East and north of the origin, in metres. */
    toMetres: ({ lat, lon }) => [
      acrossDateLine(lon - origin.lon) * METRES_PER_DEGREE * shrink,
      (lat - origin.lat) * METRES_PER_DEGREE,
    ],
    /** The position so far east and north of the origin. */
    toDegrees: ([east, north]) => ({
      lat: origin.lat + north / METRES_PER_DEGREE,
      lon: origin.lon + east / (METRES_PER_DEGREE * shrink),
    }),
  };
}

/** A difference of longitudes the short way round. */
function acrossDateLine(degrees) {
  return ((((degrees + 180) % 360) + 360) % 360) - 180;
}

/** The angle between two headings in degrees, 0 to 180. */
export function angleBetween(one, other) {
  const difference = Math.abs(one - other) % 360;
  return Math.min(difference, 360 - difference);
}

/** Points by square cells, for looking at what is near. Points are `[x, y]`. */
export class Grid {
  constructor(points, side) {
    this.points = points;
    this.side = side;
    this.cells = new Map();
    points.forEach((point, index) => {
      const name = this.#name(...this.cellOf(point));
      const cell = this.cells.get(name);
      if (cell) {
        cell.push(index);
      } else {
        this.cells.set(name, [index]);
      }
    });
  }

  /** Column and row of a point's cell. */
  cellOf([x, y]) {
    return [Math.floor(x / this.side), Math.floor(y / this.side)];
  }

  /** The indices in a cell. */
  at(column, row) {
    return this.cells.get(this.#name(column, row)) ?? [];
  }

  /** The indices of the points within so many metres of a point. */
  *within(point, radius) {
    const reach = Math.ceil(radius / this.side);
    const [column, row] = this.cellOf(point);
    for (let dx = -reach; dx <= reach; dx += 1) {
      for (let dy = -reach; dy <= reach; dy += 1) {
        for (const index of this.at(column + dx, row + dy)) {
          if (distance(point, this.points[index]) <= radius) {
            yield index;
          }
        }
      }
    }
  }

  #name(column, row) {
    return `${column},${row}`;
  }
}

/** The distance of two points. */
export function distance([x, y], [otherX, otherY]) {
  return Math.hypot(x - otherX, y - otherY);
}
