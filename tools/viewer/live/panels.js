// Panels above the bar, one open at a time: help, the places of the photographs, and the experts.
const find = (id) => document.getElementById(id);
const make = (name, properties, label) => {
  const made = Object.assign(document.createElement(name), properties);
  if (label) made.setAttribute("aria-label", label);
  return made;
};
const PANEL = "position:fixed;left:10px;max-width:min(25rem,calc(100vw - 20px));max-height:40vh;overflow:auto;background:#1c1c1cf2;border-radius:8px;padding:8px;color:#fff";
const PANELS = [["ask", "help"], ["places", "list"], ["parts", "experts"]]; // what opens what

// Keeps the panels between the bar and the top of the window.
export function fitPanels() {
  const above = find("bar").offsetHeight + 20, room = Math.max(0, innerHeight - above - 10);
  for (const [, name] of PANELS) {
    const style = find(name)?.style;
    if (style) Object.assign(style, { bottom: `${above}px`, maxHeight: `${name === "help" ? room : Math.min(room, 0.4 * innerHeight)}px`, boxSizing: "border-box" });
  }
}

// Opens or closes the panel that a button controls; without `open`, the other one of the two.
export function show(panel, open) {
  const isOpen = open ?? find(panel)?.hidden;
  fitPanels();
  for (const [by, name] of PANELS) {
    const one = find(name);
    if (!one) continue;
    one.hidden = !(isOpen && name === panel);
    if (name !== "help") one.style.display = one.hidden ? "none" : "block";
    find(by)?.setAttribute("aria-expanded", String(!one.hidden));
  }
}

// A button after another one in the bar, and the panel that it opens.
function addPanel(after, id, text, title, panel, label) {
  const button = make("button", { id, textContent: text, title }), section = make("section", { id: panel, hidden: true, tabIndex: 0 }, label);
  button.setAttribute("aria-expanded", "false");
  button.setAttribute("aria-controls", panel);
  section.style.cssText = `${PANEL};display:none`;
  button.addEventListener("click", () => show(panel));
  find(after).after(button);
  find("bar").after(section);
  return section;
}

// The places of the photographs; a click flies to one: go(i).
export function listPlaces(poses, go) {
  const list = addPanel("next", "places", "photographs", "places of the photographs", "list", "places of the photographs");
  poses.forEach((pose, i) => {
    const place = make("button", { textContent: String(i + 1), title: `fly to photograph ${i + 1}` }, `fly to photograph ${i + 1}`);
    place.style.margin = "2px";
    if (pose.picture) place.replaceChildren(make("img", { src: pose.picture, alt: "", width: 72, style: "display:block;border-radius:3px" }));
    place.addEventListener("click", () => go(i));
    list.append(place);
  });
}

const SHOWN = 3500; // milliseconds that a photograph stays

// A function that fades a photograph of the present pose in and out again: photograph(picture); without a picture, it goes.
export function makePhotograph(page) {
  const image = make("img", { alt: "the photograph", hidden: true });
  image.style.cssText = "position:fixed;pointer-events:none;opacity:0;transition:opacity .7s;left:50%;top:50%;transform:translate(-50%,-50%)";
  find("veil").after(image);
  let later = 0;
  const leave = () => (image.style.opacity = 0);
  return (picture) => {
    clearTimeout(later);
    if (!picture) return void leave();
    const share = Math.tan((page.fov * Math.PI) / 360) / Math.tan((page.shown * Math.PI) / 360); // of the screen's height
    image.hidden = false;
    image.src = picture;
    image.style.height = `${100 * share}vh`;
    image.style.width = `${100 * share * page.aspect}vh`;
    image.decode().then(() => (image.style.opacity = 1), leave);
    later = setTimeout(leave, SHOWN);
  };
}

// The experts of a scene that has several: coloured, each on or off, one alone. palette: RGB in [0, 1] of each; draw(look) draws a look:
// {mask: a bit for each expert that is drawn, coloured}.
export function listExperts(palette, draw) {
  const all = 2 ** palette.length - 1, look = { mask: all, coloured: false };
  const list = addPanel("flight", "parts", "experts", "the networks that the scene is divided among", "experts", "experts");
  const row = (label) => {
    const made = make("div", { role: "group" }, label);
    made.append(make("span", { textContent: `${label} ` }));
    made.style.padding = "2px";
    list.append(made);
    return made;
  };
  const button = (into, text, label, act) => {
    const made = make("button", { textContent: text }, label);
    made.addEventListener("click", () => (act(), update()));
    made.style.margin = "2px";
    into.append(made);
    return made;
  };
  const coloured = button(list, "colours", "colour by expert", () => (look.coloured = !look.coloured));
  const everyone = button(list, "all", "draw all experts", () => (look.mask = all));
  const shown = row("drawn"), alone = row("alone");
  const switches = palette.map((color, e) => {
    const one = button(shown, String(e + 1), `expert ${e + 1} is drawn`, () => (look.mask ^= 1 << e));
    one.style.borderBottom = `4px solid rgb(${color.map((v) => Math.round(255 * v))})`;
    return one;
  });
  const only = palette.map((_, e) => button(alone, String(e + 1), `expert ${e + 1} alone`, () => (look.mask = 1 << e)));
  const press = (one, isPressed) => (one.setAttribute("aria-pressed", String(isPressed)), (one.style.opacity = isPressed ? 1 : 0.6));
  const update = () => {
    press(coloured, look.coloured);
    press(everyone, look.mask === all);
    switches.forEach((one, e) => press(one, Boolean(look.mask & (1 << e))));
    only.forEach((one, e) => press(one, look.mask === 1 << e));
    draw(look);
  };
  update();
}
