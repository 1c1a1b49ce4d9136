/** Elements of the page. All text is text. */

/** @type {(tag: string, text: string, ...inner: Node[]) => HTMLElement} An element with text, and what it holds. */
export function element(tag, text, ...inner) {
  const made = document.createElement(tag);
  made.textContent = text;
  made.append(...inner);
  return made;
}

/** @type {(id: string) => any} */
export function byId(id) {
  return document.getElementById(`arm-${id}`);
}

/** @type {(name: string) => string} A colour or number of the page's style, by its name there. */
export function styled(name) {
  return getComputedStyle(byId("scene").parentElement).getPropertyValue(name).trim();
}
