for (const divider of document.querySelectorAll(".divider")) {
  const range = divider.querySelector("input");
  const move = () => divider.style.setProperty("--cut", range.value + "%");
  range.addEventListener("input", move);
  move();
}
