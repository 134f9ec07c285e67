// Colours of the page's style sheet for canvases; they change with the browser's colour scheme.

const dark = matchMedia("(prefers-color-scheme: dark)");
const known = new Map();
dark.addEventListener("change", () => known.clear());

// A custom property of the style sheet, such as "--ink".
export function colour(name) {
  if (!known.has(name)) known.set(name, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return known.get(name);
}

export function onTheme(redraw) {
  dark.addEventListener("change", redraw);
}
