// Starts a program: on the page, and in the worker that the page starts.
import { Page } from "./page.js";
import { fromCapture, toCapture } from "./link.js";
import { say } from "./screen.js";
import { serve, start } from "./worker.js";

const fail = (error) => {
  say(`The scene could not be shown: ${error.message}`);
  document.getElementById("bar").hidden = true;
  throw error;
};

// load(page): a promise of the scene; acts(use): further acts of the worker, see worker.js.
export function boot(load, acts) {
  if (typeof document === "undefined") return serve(self, acts);
  const code = document.currentScript.textContent, settings = JSON.parse(document.getElementById("settings").textContent);
  try {
    const page = new Page(settings, start(code));
    page.loaded = load(page).catch(fail);
    window.sceneExperts = {
      setPose: (pose) => page.setPose(fromCapture(pose, settings)), pose: () => toCapture(page.seen(), settings),
      settled: () => page.settled(), count: settings.count, frames: () => page.frames, page,
    };
  } catch (error) {
    fail(error);
  }
}
