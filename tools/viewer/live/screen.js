// What surrounds the scene: the line over it, full screen, and the address.
let said = null, told = ""; // null: what the page itself says while it loads

function write() {
  const note = document.getElementById("note");
  said ??= note.textContent;
  const text = said || told;
  note.textContent = text;
  note.hidden = !text;
}

// About the scene itself, while it loads or cannot be shown.
export const say = (text) => { said = text; write(); };
// About what somebody did, until they do something else.
export const tell = (text) => { told = text; write(); };

// Listens to what somebody does, and hides the button for full screen where the browser, or a page around this one, does not allow it.
export function watch(button) {
  for (const name of ["pointerdown", "keydown", "wheel"]) addEventListener(name, () => told && tell(""), { capture: true, passive: true });
  button.hidden = !document.fullscreenEnabled;
}

export function fullScreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else if (document.fullscreenEnabled) document.documentElement.requestFullscreen().catch((error) => tell(`Full screen is not possible: ${error.message}`));
}

// Puts a hash into the address. A page that is the text of a frame (srcdoc) has no history to replace.
export function putHash(hash) {
  try {
    history.replaceState(null, "", hash);
  } catch {
    location.hash = hash;
  }
}
