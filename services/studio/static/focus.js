// Focus that survives new elements: a control is known by its data-focus.

// Replaces the children of an element. The focus stays on the control of the same name, or else goes to the first one.
export function replaceChildren(parent, ...children) {
  const focused = parent.contains(document.activeElement) ? document.activeElement.dataset.focus : undefined;
  parent.replaceChildren(...children);
  if (focused === undefined) return;
  const control = parent.querySelector(`[data-focus="${CSS.escape(focused)}"]`) ?? parent.querySelector("button, input");
  control?.focus({ preventScroll: true });
}
