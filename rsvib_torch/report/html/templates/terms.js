// Explain terms while they are pointed at or focused, with the text of the list of terms.
const tip = document.createElement("div");
tip.className = "tip";
tip.hidden = true;
tip.setAttribute("aria-hidden", "true"); // aria-describedby has the same text
document.body.append(tip);
let explained = null;
const place = () => {
  if (!explained) return;
  const box = explained.getBoundingClientRect();
  const below = box.bottom + 6 + tip.offsetHeight < innerHeight;
  tip.style.left = Math.max(8, Math.min(box.left, innerWidth - tip.offsetWidth - 8)) + "px";
  tip.style.top = (below ? box.bottom + 6 : box.top - 6 - tip.offsetHeight) + "px";
};
const show = (event) => {
  explained = event.currentTarget;
  tip.textContent = document.getElementById(explained.getAttribute("aria-describedby")).textContent;
  tip.hidden = false;
  place();
};
const hide = () => {
  explained = null;
  tip.hidden = true;
};
for (const term of document.querySelectorAll(".term")) {
  for (const name of ["pointerenter", "focus", "click"]) term.addEventListener(name, show);
  for (const name of ["pointerleave", "blur"]) term.addEventListener(name, hide);
}
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape") hide();
});
document.addEventListener("scroll", place, true); // focus may scroll to the term
