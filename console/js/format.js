// Numbers, moments and names as a person reads them.

/** A number with so many digits after the point, or a dash where there is none. */
export function decimal(value, digits = 2) {
  return value === null || value === undefined ? "–" : value.toFixed(digits);
}

/** A share of one as a percentage. */
export function percent(share, digits = 0) {
  return `${decimal(100 * share, digits)}%`;
}

/** A count with thousands apart. */
export function count(value) {
  return value.toLocaleString("en-GB");
}

/** So many of something: `1 photo`, `2 photos`. */
export function plural(value, one, many = `${one}s`) {
  return `${count(value)} ${value === 1 ? one : many}`;
}

/** Milliseconds. */
export function milliseconds(value) {
  if (value >= 1000) {
    return `${(value / 1000).toFixed(1)} s`;
  }
  return value >= 10 ? `${value.toFixed(0)} ms` : `${value.toFixed(1)} ms`;
}

/** A distance in metres. */
export function metres(value) {
  return value >= 1000 ? `${(value / 1000).toFixed(1)} km` : `${value.toFixed(0)} m`;
}

/** The day of a moment. */
export function day(moment) {
  return new Date(moment).toISOString().slice(0, 10);
}

/** A moment to the minute, in UTC. */
export function minute(moment) {
  return `${new Date(moment).toISOString().slice(0, 16).replace("T", " ")} UTC`;
}

/** A position. */
export function position(location) {
  if (!location || location.lat === null || location.lat === undefined) {
    return null;
  }
  return `${location.lat.toFixed(6)}, ${location.lon.toFixed(6)}`;
}

/** A heading with the name of its direction. */
export function heading(location) {
  if (!location || location.heading === null || location.heading === undefined) {
    return null;
  }
  const names = ["north", "north-east", "east", "south-east"];
  names.push("south", "south-west", "west", "north-west");
  const name = names[Math.round(location.heading / 45) % 8];
  return `${location.heading.toFixed(0)}°, ${name}`;
}

/**
 * A short name for a photo. Data sets write whole records into names, `@` between their fields
 * (`@east@north@zone@letter@lat@lon@name@...`): then it is the field with the name. Else it is
 * the last part of a path.
 */
export function placeName(externalId, id) {
  if (!externalId) {
    return `photo ${id.slice(-6)}`;
  }
  const fields = externalId.split("/").pop().split("@");
  return (fields.length > 8 && fields[7]) || externalId.split("/").pop();
}
