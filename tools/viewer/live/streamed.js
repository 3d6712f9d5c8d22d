// The program of `export --format streamed-html`: the coarse scene is shown as soon as it is here, and the parts behind it as they come.
import { readCompact } from "../../../integrations/javascript/compact.mjs";
import { LayeredScene, expectPart, foreignPart } from "../../../integrations/javascript/layers.mjs";
import { boot } from "./boot.js";
import { say } from "./screen.js";
import { sceneOf } from "./worker.js";

const STALL = 30_000; // milliseconds without a byte until a part counts as missing
const TRIES = 3, PAUSE = 1000; // of a part; milliseconds between them
const WAIT = 50; // milliseconds between looks for a renderer
const pause = (milliseconds) => new Promise((done) => setTimeout(done, milliseconds));

// In the worker: bytes become scenes.
const acts = (use) => {
  let layers = null, settings = null, coarse = null;
  return {
    coarse: async ({ bytes, given }) => {
      settings = given;
      coarse = await readCompact(bytes);
      return use(sceneOf(coarse, settings));
    },
    plan: async ({ bytes }) => ((layers = await LayeredScene.open(coarse, bytes)), {}),
    chunk: ({ bytes }) => (layers.take(bytes), {}),
    show: () => use(sceneOf(layers.scene(), settings)),
  };
};

// The bytes of a part in a folder. came(count): more of them are here.
async function get(folder, part, came) {
  const [name, size] = part, stop = new AbortController();
  let timer = 0, at = 0, out = null;
  const wait = () => {
    clearTimeout(timer);
    timer = setTimeout(() => stop.abort(new Error(`no bytes of ${name} came for ${STALL / 1000} seconds`)), STALL);
  };
  wait();
  try {
    const answer = await fetch(`${encodeURIComponent(folder)}/${name}`, { signal: stop.signal });
    if (!answer.ok) throw new Error(`the server answered ${answer.status} for ${name}`);
    const reader = answer.body.getReader();
    out = new Uint8Array(size);
    for (let next = await reader.read(); !next.done; next = await reader.read()) {
      wait();
      if (at + next.value.length > size) throw foreignPart(name, `more than ${size} bytes`);
      out.set(next.value, at);
      at += next.value.length;
      came(next.value.length);
    }
  } catch (error) {
    came(-at);
    throw stop.signal.aborted ? stop.signal.reason : error.name === "TypeError" ? new Error(`${name} could not be fetched`) : error;
  } finally {
    clearTimeout(timer);
  }
  try {
    expectPart(out.subarray(0, at), part);
  } catch (error) {
    came(-at);
    throw error;
  }
  return out;
}

// A line in a corner of the page, with a button where something can be done.
function makeLine() {
  const line = document.createElement("div"), text = document.createElement("span"), again = document.createElement("button");
  line.id = "progress";
  line.setAttribute("role", "status");
  line.style.cssText = "position:fixed;left:10px;top:10px;max-width:calc(100vw - 20px);box-sizing:border-box;padding:4px 10px;border-radius:6px;color:#fff;background:#000a";
  again.textContent = "try again";
  again.style.marginLeft = "10px";
  line.append(text, again);
  document.querySelector("main").append(line);
  const tell = (words, act = null) => ((text.textContent = words), (line.hidden = !words), (again.hidden = !act), (again.onclick = act));
  tell("");
  return tell;
}

async function load(page) {
  const { settings, ask } = page, { folder, parts } = settings, total = parts.reduce((sum, [, size]) => sum + size, 0);
  if (location.protocol === "file:") throw new Error("this page loads its parts from a web server and was opened from disk; serve its folder, or export --format html");
  let here = 0, tell = null;
  const percent = () => `${Math.floor((100 * here) / total)} % of ${(total / 1e6).toFixed(1)} MB`;
  const came = (count) => ((here += count), tell ? tell(`loading: ${percent()}`) : say(`loading the scene: ${percent()}`));
  const fetchPart = async (part) => {
    for (let left = TRIES; ; await pause(PAUSE))
      try {
        return await get(folder, part, came);
      } catch (error) {
        if (--left <= 0) throw error;
      }
  };
  await ask("coarse", { bytes: await fetchPart(parts[0]), given: settings });
  await page.open(true);
  say("");
  tell = makeLine();
  page.parts = 0; // chunks that are shown
  let planned = false, taken = 0, arrived = []; // arrived: parts that were asked for ahead
  const goOn = async () => {
    try {
      came(0);
      if (!planned) await ask("plan", { bytes: await fetchPart(parts[1]) });
      planned = true;
      for (let i = 2 + taken; i < parts.length; ) {
        if (!arrived.length) arrived = [fetchPart(parts[i])];
        const bytes = await arrived.shift();
        if (i + 1 < parts.length) arrived.push(fetchPart(parts[i + 1])); // while this one is decoded
        arrived.forEach((promise) => promise.catch(() => {}));
        await ask("chunk", { bytes }).catch((error) => {
          came(-bytes.length); // it will be fetched again, and the next one with it
          arrived.splice(0).forEach((promise) => promise.then((later) => came(-later.length), () => {}));
          throw error;
        });
        i += 1;
        taken += 1;
        await ask("show");
        while (!page.renderer) await pause(WAIT); // another one opens, with what the worker had before
        await page.renderer.refresh(ask, () => page.view());
        page.wake();
        page.parts = taken;
      }
      tell("");
    } catch (error) {
      tell(`The rest of the scene is missing (${error.message}); what is shown is a part of it.`, goOn);
    }
  };
  await goOn();
}

boot(load, acts);
