// Pictures of references. The server keeps none; the page knows those that its user chose from the
// disk or added in this tab, by name.

import { element } from "./dom.js";

const files = new Map();

/** Remembers photos, so that they can be shown beside answers. */
export function remember(photos) {
  for (const photo of photos) {
    files.set(photo.name, photo);
  }
  return files.size;
}

/** The photo that a reference was made of, as far as its name tells; null if it is not known. */
export function pictureOf(externalId) {
  return externalId ? (files.get(externalId.split("/").pop()) ?? null) : null;
}

/**
 * Whether a photo is the one that a reference was made of: their contents are compared. Null where
 * the browser offers no way to tell, which it does only to pages that came encrypted or from this
 * machine.
 */
export async function isSameContent(photo, sha256) {
  if (!window.crypto?.subtle) {
    return null;
  }
  const digest = await crypto.subtle.digest("SHA-256", await photo.arrayBuffer());
  const bytes = [...new Uint8Array(digest)];
  return bytes.map((byte) => byte.toString(16).padStart(2, "0")).join("") === sha256;
}

/** A photo as a bitmap that fits into so many pixels; null if the browser cannot read it. */
export async function bitmapOf(photo, longestSide) {
  if (!photo) {
    return null;
  }
  try {
    const whole = await createImageBitmap(photo);
    const scale = Math.min(1, longestSide / Math.max(whole.width, whole.height));
    const size = {
      resizeWidth: Math.max(1, Math.round(whole.width * scale)),
      resizeHeight: Math.max(1, Math.round(whole.height * scale)),
      resizeQuality: "medium",
    };
    const small = await createImageBitmap(whole, size);
    whole.close();
    return small;
  } catch {
    return null;
  }
}

/** A small picture of a photo, or an empty frame. */
export function thumbnail(photo, alternative) {
  const canvas = element("canvas", { class: "thumb", width: 176, height: 132, role: "img" });
  canvas.setAttribute("aria-label", photo ? alternative : `${alternative}: no picture`);
  bitmapOf(photo, 264).then((bitmap) => {
    if (bitmap) {
      drawCovering(canvas.getContext("2d"), bitmap, canvas.width, canvas.height);
      bitmap.close();
    }
  });
  return canvas;
}

/** Draws a bitmap so that it fills the place, cutting off what is too much. */
function drawCovering(context, bitmap, width, height) {
  const scale = Math.max(width / bitmap.width, height / bitmap.height);
  const [w, h] = [bitmap.width * scale, bitmap.height * scale];
  context.drawImage(bitmap, (width - w) / 2, (height - h) / 2, w, h);
}
