// Move the line between two images with pointer and keyboard.
for (const figure of document.querySelectorAll(".compare")) {
  const range = figure.querySelector(".range");
  if (!range) continue;
  const move = () => {
    figure.style.setProperty("--cut", range.value + "%");
    range.setAttribute("aria-valuetext", Math.round(range.value) + " % from the left");
  };
  const steps = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10 }; // %
  range.addEventListener("keydown", (event) => {
    if (!(event.key in steps)) return;
    event.preventDefault(); // the step of the element itself is 0.1 %, for the pointer
    range.value = Math.min(100, Math.max(0, Math.round(range.value) + steps[event.key]));
    move();
  });
  range.addEventListener("input", move);
  move();
}
