/** Compressed data on a page. */

/** @type {(base64: string) => Uint8Array} */
export function decoded(base64) {
  return Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
}

/** @type {(id: string) => Promise<ArrayBuffer>} The content of an element, by its id. */
export async function unpacked(id) {
  const bytes = decoded(document.getElementById(id)?.textContent ?? "");
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
}

/** @returns {Promise<any>} The content of a plotly page; it also loads plotly's library. */
export async function plotlyContent() {
  const [library, content] = await Promise.all(["library", "content"].map(unpacked));
  const script = document.createElement("script"), decoder = new TextDecoder();
  script.textContent = decoder.decode(library);
  document.head.append(script);
  return JSON.parse(decoder.decode(content));
}
