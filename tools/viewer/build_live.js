// Bundles live/main.js and live/streamed.js into one script each, with the checksum of its sources, by which a test sees whether the script is that of the sources.
import { createHash } from "node:crypto";
import { readFileSync, readdirSync, writeFileSync } from "node:fs";
import { gzipSync } from "node:zlib";
import { build } from "esbuild";

const at = (name) => new URL(name, import.meta.url);
const sources = ["live/", "../../integrations/javascript/"].flatMap((folder) => readdirSync(at(folder)).sort().map((name) => folder + name));
const sum = createHash("sha256");
for (const name of sources) sum.update(readFileSync(at(name)));
const checksum = sum.digest("hex");
for (const [entry, name] of [["main", "live"], ["streamed", "streamed"]]) {
  const made = await build({
    entryPoints: [at(`live/${entry}.js`).pathname], bundle: true, minify: true, format: "iife", target: "es2022", legalComments: "none", write: false,
  });
  const code = Buffer.from(made.outputFiles[0].contents).toString().replaceAll("</script", "<\\/script");
  writeFileSync(at(`../../src/scene_experts/files/formats/assets/${name}.min.js.gz`), gzipSync(`// ${checksum}\n${code}`, { level: 9 }));
}
