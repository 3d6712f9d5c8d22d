// The program of `export --format html`. It runs twice: on the page, and in the worker that the page starts.
import { boot } from "./boot.js";

boot((page) => page.load(document.getElementById("scene").textContent));
