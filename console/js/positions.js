// Positions of photos from a CSV file: `file,lat,lon,heading,captured_at`, in any order.

/** Other names of the columns. */
const COLUMNS = {
  file: ["file", "filename", "name", "image", "photo"],
  lat: ["lat", "latitude"],
  lon: ["lon", "lng", "longitude"],
  heading: ["heading", "yaw", "bearing"],
  captured_at: ["captured_at", "time", "timestamp"],
};

/**
 * The fields of each photo by the last part of its path. Throws an `Error` that says what is wrong
 * with the file.
 */
export function readPositions(text) {
  const [header, ...rows] = rowsOf(text);
  const names = (header ?? []).map((name) => name.trim().toLowerCase());
  const columnOf = (field) => names.findIndex((name) => COLUMNS[field].includes(name));
  const columns = Object.keys(COLUMNS).map((field) => [field, columnOf(field)]);
  const found = Object.fromEntries(columns.filter(([, column]) => column >= 0));
  if (found.file === undefined) {
    throw new Error("The CSV file has no column named file.");
  }
  const positions = new Map();
  for (const row of rows.filter((cells) => cells.some((cell) => cell !== ""))) {
    const fields = {};
    for (const [field, column] of Object.entries(found)) {
      const value = row[column]?.trim();
      if (field !== "file" && value) {
        fields[field] = value;
      }
    }
    const name = row[found.file].replaceAll("\\", "/").split("/").pop();
    positions.set(name, fields);
  }
  return positions;
}

/** The cells of each line; a cell in quotes may have commas, quotes and line ends. */
function rowsOf(text) {
  const rows = [[]];
  const cells = /("(?:[^"]|"")*"|[^,\r\n]*)(,|\r?\n|$)/g;
  for (const [whole, cell, end] of text.replace(/^\uFEFF/, "").matchAll(cells)) {
    const isQuoted = cell.startsWith('"');
    const value = isQuoted ? cell.slice(1, -1).replaceAll('""', '"') : cell;
    rows[rows.length - 1].push(value);
    if (end !== "," && end !== "") {
      rows.push([]);
    }
    if (whole === "" || end === "") {
      break;
    }
  }
  return rows;
}
