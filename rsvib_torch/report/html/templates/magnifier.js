// Show pixels around a position of the frame, of both images side by side.
for (const figure of document.querySelectorAll(".compare")) {
  const button = figure.querySelector(".magnify");
  if (!button) continue;
  const stage = figure.querySelector(".stage");
  const lens = figure.querySelector(".lens");
  const marker = figure.querySelector(".marker");
  const row = figure.querySelector(".row");
  const column = figure.querySelector(".column");
  const glasses = [...lens.querySelectorAll("canvas")];
  const shown = [...stage.querySelectorAll("img")].reverse(); // before, after
  const full = [...figure.querySelectorAll("img.full")];
  const images = full.length ? full : shown;
  const left = full.length ? Number(full[0].dataset.left) : 0; // px of the frame
  const top = full.length ? Number(full[0].dataset.top) : 0;
  const scale = Number(figure.dataset.scale); // px of the shown images per px of the frame
  let at = null; // centre in px of the frame

  const draw = () => {
    const width = images[0].naturalWidth;
    const height = images[0].naturalHeight;
    if (!width) return; // not decoded yet
    const size = Math.min(40, width, height);
    at ??= {
      x: Number(figure.dataset.column ?? left + width / 2),
      y: Number(figure.dataset.row ?? top + height / 2),
    };
    const inside = (value, first, length) =>
      Math.min(first + length - size, Math.max(first, Math.round(value - size / 2)));
    const x = inside(at.x, left, width);
    const y = inside(at.y, top, height);
    glasses.forEach((canvas, index) => {
      canvas.width = canvas.height = size; // one canvas pixel per pixel; the style sheet enlarges them as squares
      canvas.getContext("2d").drawImage(images[index], x - left, y - top, size, size, 0, 0, size, size);
    });
    row.value = y + Math.floor(size / 2);
    column.value = x + Math.floor(size / 2);
    const percent = (value, length) => (100 * scale * value) / length + "%";
    const whole = { width: shown[0].naturalWidth, height: shown[0].naturalHeight };
    marker.style.left = percent(x, whole.width);
    marker.style.top = percent(y, whole.height);
    marker.style.width = percent(size, whole.width);
    marker.style.height = percent(size, whole.height);
  };
  const point = (event) => {
    if (lens.hidden) return;
    const box = stage.getBoundingClientRect();
    at = {
      x: (((event.clientX - box.left) / box.width) * shown[0].naturalWidth) / scale,
      y: (((event.clientY - box.top) / box.height) * shown[0].naturalHeight) / scale,
    };
    draw();
  };
  button.addEventListener("click", () => {
    lens.hidden = marker.hidden = !lens.hidden;
    button.setAttribute("aria-pressed", String(!lens.hidden));
    figure.classList.toggle("magnified", !lens.hidden);
    if (!lens.hidden) Promise.all(images.map((image) => image.decode())).then(draw, draw);
  });
  stage.addEventListener("pointermove", point);
  stage.addEventListener("pointerdown", point);
  for (const input of [row, column]) {
    input.addEventListener("change", () => {
      if (row.value === "" || column.value === "") return;
      at = { x: Number(column.value), y: Number(row.value) };
      draw();
    });
  }
}
