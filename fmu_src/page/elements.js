/** Elements of the page. Texts are never parsed as HTML. */

/** @type {(tag: string, text: string, ...inner: Node[]) => HTMLElement} An element with a text and inner elements. */
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

/** @type {(name: string) => string} A colour or number in the page's style, by the name of its CSS variable. */
export function styled(name) {
  return getComputedStyle(byId("scene").parentElement).getPropertyValue(name).trim();
}
