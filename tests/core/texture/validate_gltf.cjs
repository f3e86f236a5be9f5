// SPDX-License-Identifier: GPL-3.0-or-later
// node validate_gltf.cjs PACKAGE FILE...: print what the Khronos validator says of each file, as JSON.
const fs = require("fs");
const [folder, ...files] = process.argv.slice(2);
const { validateBytes } = require(folder);
Promise.all(
  files.map((file) => validateBytes(new Uint8Array(fs.readFileSync(file)), { maxIssues: 100 })),
).then((reports) => process.stdout.write(JSON.stringify(reports)));
