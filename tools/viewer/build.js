// Bundles viewer.js with Spark and three.js into one script, which starts with the checksum of its sources, and writes it beside the licences
// of what is in it.
import { createHash } from "node:crypto";
import { readFileSync, writeFileSync } from "node:fs";
import { gzipSync } from "node:zlib";
import { build } from "esbuild";

const out = new URL("../../src/scene_experts/files/formats/assets/", import.meta.url);
const made = await build({
  entryPoints: ["viewer.js"], bundle: true, minify: true, format: "iife", target: "es2021", legalComments: "none", write: false, metafile: true,
});
const sum = createHash("sha256");
const own = Object.keys(made.metafile.inputs).filter((name) => !name.startsWith("node_modules/")).sort();
for (const name of [...own, "build.js", "package.json"]) sum.update(readFileSync(new URL(name, import.meta.url)));
const code = Buffer.from(made.outputFiles[0].contents).toString().replaceAll("</script", "<\\/script");
writeFileSync(new URL("viewer.min.js.gz", out), gzipSync(`// ${sum.digest("hex")}\n${code}`, { level: 9 }));
const parts = ["@sparkjsdev/spark", "three", "fflate"].map((name) => {
  const at = new URL(`node_modules/${name}/`, import.meta.url);
  const { version } = JSON.parse(readFileSync(new URL("package.json", at)));
  return `${name} ${version}\n\n${readFileSync(new URL("LICENSE", at), "utf8").trim()}\n`;
});
writeFileSync(new URL("LICENCES.txt", out), parts.join("\n\n"));
