// Requests to the server that the page came from, and to no other.

import { announce, key } from "./session.js";

/** Attempts at a request that the server asks to repeat later. */
const ATTEMPTS = 5;

/** Longest wait that is waited for, in seconds. */
const LONGEST_WAIT = 30;

/** The server refused a request; the fields are those of its problem document. */
export class Refusal extends Error {
  constructor(problem, status, retryAfter) {
    super(problem.detail ?? `the server answered with status ${status}`);
    this.code = problem.code ?? "unknown";
    this.status = status;
    this.title = problem.title ?? "The server refused this";
    this.requestId = problem.request_id ?? null;
    this.retryAfter = retryAfter;
  }
}

/** No answer came. */
export class Unreachable extends Error {}

/** An error in words, with the request's id where the server's log knows it. */
export function inWords(error) {
  if (error instanceof Refusal) {
    const id = error.requestId ? ` (request ${error.requestId})` : "";
    return `${error.title}: ${error.message}${id}`;
  }
  return error.message;
}

/**
 * Sends a request and gives the answer's JSON, or what `options.read` makes of the response. When the server asks to come back later, that is
 * done. Throws a `Refusal`, or `Unreachable`.
 */
export async function call(method, path, options = {}) {
  for (let attempt = 1; ; attempt += 1) {
    const response = await send(method, path, options);
    if (response.ok || (options.accept ?? []).includes(response.status)) {
      return (options.read ?? bodyOf)(response);
    }
    const refusal = await refusalOf(response);
    if (refusal.status === 401) {
      announce("locked", refusal);
    }
    const wait = refusal.retryAfter;
    if (wait === null || wait > LONGEST_WAIT || attempt === ATTEMPTS) {
      throw refusal;
    }
    await pause(1000 * wait, options.signal);
  }
}

async function send(method, path, { params, body, type, signal }) {
  const url = new URL(path, window.location.origin);
  for (const [name, value] of Object.entries(params ?? {})) {
    if (value !== null && value !== undefined && value !== "") {
      url.searchParams.set(name, value);
    }
  }
  const headers = {};
  if (key()) {
    headers.authorization = `Bearer ${key()}`;
  }
  if (type) {
    headers["content-type"] = type;
  }
  try {
    return await fetch(url, { method, headers, body, signal, cache: "no-store" });
  } catch (error) {
    if (signal?.aborted) {
      throw error;
    }
    throw new Unreachable("The server does not answer.", { cause: error });
  }
}

async function bodyOf(response) {
  return response.status === 204 ? null : response.json();
}

async function refusalOf(response) {
  let problem = {};
  try {
    problem = await response.json();
  } catch {
    // A proxy in between answers in its own way.
  }
  const seconds = Number.parseInt(response.headers.get("retry-after") ?? "", 10);
  return new Refusal(problem, response.status, Number.isNaN(seconds) ? null : seconds);
}

/** Waits, unless the signal ends it. */
export function pause(ms, signal = null) {
  return new Promise((resolve, reject) => {
    if (signal?.aborted) {
      reject(signal.reason);
    }
    const timer = setTimeout(resolve, ms);
    signal?.addEventListener("abort", () => {
      clearTimeout(timer);
      reject(signal.reason);
    });
  });
}

/** The places that a photo may show. */
export function query(map, photo, options, signal) {
  return call("POST", "/query", {
    params: { map, ...options },
    body: photo,
    type: "application/octet-stream",
    signal,
  });
}

/** The evidence that a photo and a reference show the same place. */
export function match(photo, referenceId, signal) {
  return call("POST", "/match", {
    params: { reference_id: referenceId, key_patches: true },
    body: photo,
    type: "application/octet-stream",
    signal,
  });
}

/** Stores a photo: `{reference, isNew}`. */
export function addReference(map, photo, fields, signal) {
  return call("POST", "/references", {
    params: { map, ...fields },
    body: photo,
    type: "application/octet-stream",
    signal,
    read: async (response) => ({
      reference: await response.json(),
      isNew: response.status === 201,
    }),
  });
}

/** The references of a map, page by page: `{references, next}`. */
export async function* referencePages(map, limit, signal) {
  let cursor = null;
  do {
    const page = await call("GET", "/references", { params: { map, limit, cursor }, signal });
    yield page.references;
    cursor = page.next;
  } while (cursor !== null && cursor !== undefined);
}
