// Unpacks what stands packed on a page.
"use strict";

/** @param {string} id @returns {Promise<string>} what was packed into the page under that name */
async function unpackedText(id) {
  const packed = atob(/** @type {HTMLElement} */ (document.getElementById(id)).textContent || "");
  const bytes = new Uint8Array(packed.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = packed.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).text();
}
