/** Compressed data on a page. */

/** @type {(id: string) => Promise<ArrayBuffer>} The content of an element, by its id. */
export async function unpacked(id) {
  const text = atob(document.getElementById(id)?.textContent ?? ""), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
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
