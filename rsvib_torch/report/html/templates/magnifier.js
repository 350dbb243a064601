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
  const images = [...stage.querySelectorAll("img")].reverse(); // before, after
  let at = { x: Number(figure.dataset.column), y: Number(figure.dataset.row) }; // centre in px

  const draw = () => {
    const width = images[0].naturalWidth;
    const height = images[0].naturalHeight;
    if (!width) return; // not decoded yet
    const size = Math.min(40, width, height);
    const inside = (value, length) => Math.min(length - size, Math.max(0, Math.round(value - size / 2)));
    const x = inside(at.x, width);
    const y = inside(at.y, height);
    glasses.forEach((canvas, index) => {
      canvas.width = canvas.height = size; // one canvas pixel per pixel; the style sheet enlarges them as squares
      canvas.getContext("2d").drawImage(images[index], x, y, size, size, 0, 0, size, size);
    });
    row.value = y + Math.floor(size / 2);
    column.value = x + Math.floor(size / 2);
    const percent = (value, length) => (100 * value) / length + "%";
    marker.style.left = percent(x, width);
    marker.style.top = percent(y, height);
    marker.style.width = percent(size, width);
    marker.style.height = percent(size, height);
  };
  const point = (event) => {
    if (lens.hidden) return;
    const box = stage.getBoundingClientRect();
    at = {
      x: ((event.clientX - box.left) / box.width) * images[0].naturalWidth,
      y: ((event.clientY - box.top) / box.height) * images[0].naturalHeight,
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
