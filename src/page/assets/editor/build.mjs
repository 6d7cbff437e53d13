// Makes ../codemirror.js from editor.mjs and the packages of package-lock.json, with their licences.
import { build } from "esbuild";
import { existsSync, readFileSync } from "node:fs";

const lock = JSON.parse(readFileSync("package-lock.json", "utf8"));
const licences = new Map();
for (const [folder, { dev, version }] of Object.entries(lock.packages)) {
  if (!folder || dev) continue;
  const file = ["LICENSE", "LICENSE.md", "LICENSE.txt"].map((name) => `${folder}/${name}`).find((path) => existsSync(path));
  if (!file) throw new Error(`${folder} has no licence`);
  const text = readFileSync(file, "utf8").trim();
  const names = licences.get(text) || [];
  licences.set(text, [...names, `${folder.replace("node_modules/", "")} ${version}`]);
}
const banner = [...licences].map(([text, names]) => `${names.join(", ")}\n\n${text}`).join("\n\n");

await build({
  entryPoints: ["editor.mjs"], outfile: "../codemirror.js", bundle: true, minify: true, format: "iife", globalName: "codeMirror", target: "es2021",
  charset: "utf8", legalComments: "none", banner: { js: `/*! Made by editor/build.mjs; do not edit.\n\n${banner.replaceAll("*/", "* /")}\n*/` },
});
