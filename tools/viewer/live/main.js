// The program of `export --format live`. It runs twice: on the page, and in the worker that the page starts.
import { Page, say } from "./page.js";
import { serve, start } from "./worker.js";

const fail = (error) => {
  say(`The scene could not be shown: ${error.message}`);
  document.getElementById("bar").hidden = true;
  throw error;
};

if (typeof document === "undefined") serve(self);
else {
  const code = document.currentScript.textContent, settings = JSON.parse(document.getElementById("settings").textContent);
  try {
    const page = new Page(settings, start(code));
    page.loaded = page.load(document.getElementById("scene").textContent).catch(fail);
    window.sceneExperts = {
      setPose: (pose) => page.setPose(pose), pose: () => page.pose(), settled: () => page.settled(), count: settings.count, frames: () => page.frames, page,
    };
  } catch (error) {
    fail(error);
  }
}
