// Bundles live/main.js into one script, with the checksum of its sources, by which a test sees whether the script is that of the sources.
import { createHash } from "node:crypto";
import { readFileSync, readdirSync, writeFileSync } from "node:fs";
import { gzipSync } from "node:zlib";
import { build } from "esbuild";

const at = (name) => new URL(name, import.meta.url);
const sources = [...readdirSync(at("live/")).sort().map((name) => `live/${name}`), "../../integrations/javascript/compact.mjs"];
const sum = createHash("sha256");
for (const name of sources) sum.update(readFileSync(at(name)));
const made = await build({
  entryPoints: [at("live/main.js").pathname], bundle: true, minify: true, format: "iife", target: "es2022", legalComments: "none", write: false,
});
const code = Buffer.from(made.outputFiles[0].contents).toString().replaceAll("</script", "<\\/script");
writeFileSync(at("../../src/scene_experts/files/formats/assets/live.min.js.gz"), gzipSync(`// ${sum.digest("hex")}\n${code}`, { level: 9 }));
