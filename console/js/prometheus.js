// Reads the text that Prometheus reads, as far as the page needs it: samples with their labels, and
// quantiles of histograms.

/** Every sample of a text: `{name, labels, value}`. */
export function parse(text) {
  const samples = [];
  for (const line of text.split("\n")) {
    const found = /^([a-zA-Z_:][\w:]*)(?:\{(.*)\})? (\S+)/.exec(line);
    if (found) {
      const value = found[3] === "+Inf" ? Infinity : Number(found[3]);
      samples.push({ name: found[1], labels: labelsOf(found[2] ?? ""), value });
    }
  }
  return samples;
}

function labelsOf(text) {
  const labels = {};
  for (const [, name, value] of text.matchAll(/(\w+)="((?:[^"\\]|\\.)*)"/g)) {
    labels[name] = value.replace(/\\(.)/g, (_, letter) => (letter === "n" ? "\n" : letter));
  }
  return labels;
}

/** The value of a sample with these labels; null if there is none. */
export function valueOf(samples, name, labels = {}) {
  const wanted = Object.entries(labels);
  const found = samples.find(
    (sample) =>
      sample.name === name && wanted.every(([label, value]) => sample.labels[label] === value),
  );
  return found ? found.value : null;
}

/**
 * Histograms by the value of a label: upper ends of the buckets, and how much is at or below each.
 * Where `before` has the samples of an earlier moment, only what came since counts.
 */
export function histograms(samples, name, label, before = []) {
  const earlier = new Map();
  const keyOf = (sample) => `${sample.labels[label]} ${sample.labels.le}`;
  for (const sample of before.filter((one) => one.name === `${name}_bucket`)) {
    earlier.set(keyOf(sample), sample.value);
  }
  const found = new Map();
  for (const sample of samples.filter((one) => one.name === `${name}_bucket`)) {
    const buckets = found.get(sample.labels[label]) ?? [];
    const end = sample.labels.le === "+Inf" ? Infinity : Number(sample.labels.le);
    // A server that was started anew counts from zero again.
    const since = Math.max(0, sample.value - (earlier.get(keyOf(sample)) ?? 0));
    buckets.push({ end, below: since });
    found.set(sample.labels[label], buckets);
  }
  for (const buckets of found.values()) {
    buckets.sort((one, other) => one.end - other.end);
  }
  return found;
}

/** How much a histogram counted. */
export function total(buckets) {
  return buckets.length === 0 ? 0 : buckets[buckets.length - 1].below;
}

/**
 * The value that a share of what was counted does not exceed, taken as evenly spread within its
 * bucket, as Prometheus does it. Null if nothing was counted.
 */
export function quantile(buckets, share) {
  const wanted = share * total(buckets);
  if (total(buckets) === 0) {
    return null;
  }
  let start = 0;
  let belowStart = 0;
  for (const { end, below } of buckets) {
    if (below >= wanted && below > belowStart) {
      return end === Infinity
        ? start
        : start + ((end - start) * (wanted - belowStart)) / (below - belowStart);
    }
    [start, belowStart] = [end, below];
  }
  return start;
}
