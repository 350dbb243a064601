// Show two consecutive frames in turn.
const reduced = matchMedia("(prefers-reduced-motion: reduce)");
for (const figure of document.querySelectorAll(".blink")) {
  const start = figure.querySelector(".start");
  const labels = [...figure.querySelectorAll(".which")];
  let timer = 0;
  const step = () => {
    const second = figure.classList.toggle("other");
    for (const label of labels) label.textContent = "frame " + (second ? figure.dataset.second : figure.dataset.first);
  };
  const stop = () => {
    clearInterval(timer);
    timer = 0;
    start.textContent = "Start blinking";
    start.setAttribute("aria-pressed", "false");
  };
  start.addEventListener("click", () => {
    if (timer) return stop();
    step();
    timer = setInterval(step, 500); // ms; two changes per second, three are allowed (WCAG 2.3.1)
    start.textContent = "Stop blinking";
    start.setAttribute("aria-pressed", "true");
  });
  figure.querySelector(".step").addEventListener("click", () => {
    stop();
    step();
  });
  const respect = () => {
    if (reduced.matches) stop();
    start.hidden = reduced.matches; // the button for single steps remains
  };
  reduced.addEventListener("change", respect);
  respect();
}
