// Colours of the page's style sheet, for what is drawn on canvases; they change with the browser's colour scheme.

const dark = matchMedia("(prefers-color-scheme: dark)");
const known = new Map();
dark.addEventListener("change", () => known.clear());

// A custom property of the style sheet, such as "--ink".
export function colour(name) {
  if (!known.has(name)) known.set(name, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return known.get(name);
}

// The same of a colour #rrggbb as three numbers from 0 to 1.
export function rgb(name) {
  const text = colour(name);
  return [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16) / 255);
}

export function onTheme(redraw) {
  dark.addEventListener("change", redraw);
}
