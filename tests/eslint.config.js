/** Rules of the pages' scripts: a file declares or imports all that it uses, and uses all that it declares. */
const path = require("node:path");
const { configs } = require("@eslint/js");

const browser = `Blob DecompressionStream DataView HTMLElement Option Plotly Response TextDecoder TextEncoder URL
  WebAssembly WebSocket addEventListener atob clearTimeout devicePixelRatio document getComputedStyle history location
  matchMedia performance requestAnimationFrame setTimeout window`;
const stricter = ["eqeqeq", "no-duplicate-imports", "no-useless-return", "no-var", "prefer-const"];

module.exports = [
  {
    basePath: path.dirname(__dirname),
    files: ["fmu_src/page/*.js", "twodof/plots/*.js"],
    languageOptions: { globals: Object.fromEntries(browser.split(/\s+/).map((name) => [name, "readonly"])) },
    rules: { ...configs.recommended.rules, ...Object.fromEntries(stricter.map((rule) => [rule, "error"])), "no-shadow": ["error", { allow: ["_"] }] },
  },
];
