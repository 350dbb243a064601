// Run the script of a report page in node with the part of the DOM that it uses, and print what it did as JSON.
"use strict";
const fs = require("fs");

class Element {
  constructor(tag, attributes = {}) {
    this.tag = tag;
    this.attributes = attributes;
    this.children = [];
    this.text = "";
    this.listeners = {};
    this.classes = new Set((attributes.class ?? "").split(" "));
    this.hidden = "hidden" in attributes;
    this.value = attributes.value ?? "";
    this.naturalWidth = Number(attributes.width ?? 0);
    this.naturalHeight = Number(attributes.height ?? 0);
    this.dataset = {};
    for (const name in attributes) if (name.startsWith("data-")) this.dataset[name.slice(5)] = attributes[name];
    this.properties = {};
    this.style = { setProperty: (name, value) => (this.properties[name] = value) };
    this.classList = {
      toggle: (name, wanted = !this.classes.has(name)) => {
        this.classes[wanted ? "add" : "delete"](name);
        return wanted;
      },
    };
    this.drawn = null;
  }
  get textContent() { return this.text + this.children.map((child) => child.textContent).join(""); }
  set textContent(text) { this.text = text; this.children = []; }
  get offsetWidth() { return 300; }
  get offsetHeight() { return 100; }
  getAttribute(name) { return this.attributes[name]; }
  setAttribute(name, value) { this.attributes[name] = value; }
  append(child) { this.children.push(child); }
  getBoundingClientRect() { return this.box ?? { left: 0, top: 0, bottom: 20, width: 200, height: 100 }; }
  decode() { return Promise.resolve(); }
  getContext() { return { drawImage: (...how) => (this.drawn = how) }; }
  *inside() { for (const child of this.children) { yield child; yield* child.inside(); } }
  matches(selector) {
    const [tag, ...classes] = selector.split(".");
    return (!tag || tag === this.tag) && classes.every((name) => this.classes.has(name));
  }
  querySelectorAll(selector) { return [...this.inside()].filter((element) => element.matches(selector)); }
  querySelector(selector) { return this.querySelectorAll(selector)[0] ?? null; }
  addEventListener(name, listener) { (this.listeners[name] ??= []).push(listener); }
  fire(name, event = {}) {
    const whole = { preventDefault() { this.prevented = true; }, currentTarget: this, ...event };
    for (const listener of this.listeners[name] ?? []) listener(whole);
    return whole.prevented === true;
  }
}

const html = fs.readFileSync(process.argv[2], "utf8");
const [markup, script] = html.split("<script>");
const open = [new Element("document")];
for (const [, close, tag, rest, text] of markup.split("<body>")[1].matchAll(/<(\/?)([a-z0-9]+)([^>]*)>([^<]*)/g)) {
  if (close) { open.pop(); continue; }
  const attributes = {};
  for (const [, name, , value] of rest.matchAll(/([a-z-]+)(="([^"]*)")?/g)) attributes[name] = value ?? "";
  const element = new Element(tag, attributes);
  element.text = text;
  open.at(-1).append(element);
  if (!["img", "input", "meta", "br"].includes(tag)) open.push(element);
}
const page = open[0];
page.body = page.querySelector("main");
page.createElement = (tag) => new Element(tag);
page.getElementById = (id) => [...page.inside()].find((element) => element.attributes.id === id);
const query = { matches: process.argv[3] === "reduced", addEventListener() {} };
let tick = null;
new Function("document", "matchMedia", "setInterval", "clearInterval", "innerWidth", "innerHeight", script.split("</script>")[0])(
  page, () => query, (step) => { tick = step; return 1; }, () => { tick = null; }, 1000, 800,
);

(async () => {
  const result = {};
  const range = page.querySelector(".range");
  if (range) {
    const compare = page.querySelector(".compare");
    result.cuts = ["ArrowLeft", "ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "PageUp", "Tab"].map((key) => {
      const prevented = range.fire("keydown", { key });
      return [key, compare.properties["--cut"], prevented];
    });
    for (const [value, key] of [[99.7, "ArrowRight"], [0.3, "ArrowLeft"]]) {
      range.value = value;
      range.fire("keydown", { key });
      result.cuts.push([key, compare.properties["--cut"], true]);
    }
    result.spoken = range.attributes["aria-valuetext"];
  }
  const magnify = page.querySelector(".magnify");
  if (magnify) {
    const stage = page.querySelector(".stage");
    const seen = () => ({
      drawn: page.querySelectorAll("canvas").map((canvas) => canvas.drawn && [canvas.drawn[0].attributes.alt, ...canvas.drawn.slice(1)]),
      row: page.querySelector(".row").value,
      column: page.querySelector(".column").value,
      hidden: page.querySelector(".lens").hidden,
      pressed: magnify.attributes["aria-pressed"],
    });
    stage.fire("pointermove", { clientX: 10, clientY: 10 });
    result.off = seen();
    magnify.fire("click");
    await new Promise((resolve) => setTimeout(resolve, 1));
    result.first = seen();
    stage.fire("pointermove", { clientX: 150, clientY: 25 });
    result.pointed = seen();
    page.querySelector(".row").value = "5";
    page.querySelector(".row").fire("change");
    result.entered = seen();
    magnify.fire("click");
    result.closed = seen().hidden;
  }
  const start = page.querySelector(".start");
  if (start) {
    const blink = page.querySelector(".blink");
    const seen = () => [blink.classes.has("other"), page.querySelectorAll(".which").map((label) => label.textContent), start.textContent, tick !== null];
    result.start_hidden = start.hidden;
    start.fire("click");
    result.blink = [seen()];
    for (let count = 0; count < 2; count++) { tick(); result.blink.push(seen()); }
    start.fire("click");
    result.blink.push(seen());
    start.fire("click");
    page.querySelector(".step").fire("click");
    result.blink.push(seen());
  }
  console.log(JSON.stringify(result));
})();
