// Bundle the page: `node build.mjs POLICIES OUT`, with the folder of exported policies and the folder to write to.

import {copyFile, mkdir, readFile, readdir} from "node:fs/promises";
import {fileURLToPath} from "node:url";
import {join} from "node:path";
import {gzipSync} from "node:zlib";
import {build} from "esbuild";

const [policyFolder, out] = process.argv.slice(2);
if (!policyFolder || !out) throw new Error("Name two folders: node build.mjs POLICIES OUT.");
const page = fileURLToPath(new URL(".", import.meta.url));
const xmlFolder = join(page, "..", "xml"), wasm = join(page, "node_modules/@mujoco/mujoco/mujoco.wasm");

// The texts of a folder's files of an ending, by name.
async function texts(folder, ending) {
  const names = (await readdir(folder)).filter((name) => name.endsWith(ending)).sort();
  const read = async (name) => [name, await readFile(join(folder, name), "utf8")];
  return Object.fromEntries(await Promise.all(names.map(read)));
}

// What the sources import that is no source: name to contents and how esbuild is to take them.
function given(contents) {
  const filter = new RegExp(`^(${Object.keys(contents).map((name) => name.replaceAll(".", "\\.")).join("|")})$`);
  return {
    name: "given",
    setup(setup) {
      setup.onResolve({filter}, ({path}) => ({path, namespace: "given"}));
      setup.onLoad({filter: /.*/, namespace: "given"}, async ({path}) => contents[path]());
    },
  };
}

const common = {
  bundle: true, minify: true, format: "iife", target: "es2022", legalComments: "eof", logLevel: "warning",
};

const worker = await build({
  ...common,
  entryPoints: [join(page, "src/physics/worker.js")],
  write: false,
  // MuJoCo's loader asks where it lies. It fetches nothing from there, for it is handed its bytes.
  define: {"import.meta.url": "'file:///'"},
  external: ["module", "node:*"],
  plugins: [given({
    "mujoco.wasm.gz": async () => ({contents: gzipSync(await readFile(wasm), {level: 9}), loader: "binary"}),
    "xml": async () => ({contents: JSON.stringify(await texts(xmlFolder, ".xml")), loader: "json"}),
  })],
});

await mkdir(out, {recursive: true});
await build({
  ...common,
  entryPoints: [join(page, "src/view/main.js")],
  outfile: join(out, "drive.js"),
  plugins: [given({
    "worker": async () => ({contents: worker.outputFiles[0].text, loader: "text"}),
    "policies": async () => ({contents: JSON.stringify(await texts(policyFolder, ".json")), loader: "json"}),
  })],
});
await copyFile(join(page, "src/view/style.css"), join(out, "style.css"));
await copyFile(join(page, "src/view/index.html"), join(out, "index.html"));
