/// <reference types="vitest/config" />
import { defineConfig, type Plugin } from "vite";
import { VitePWA } from "vite-plugin-pwa";

/** Where the service looks for the built pages. */
const PAGES = "../service/specimap_service/pages";

/**
 * Leave out the GLSL of three.js's own materials, 125 kB: the viewer draws with shaders of its own
 * (src/viewer/render/materials.ts) and uses none of them.
 */
const withoutShaderChunks: Plugin = {
  name: "without-shader-chunks",
  apply: "build",
  transform(code, id) {
    if (!id.endsWith("three/build/three.module.js")) return undefined;
    const lean = code.replace(/^(?:var|const) (\w+) = "(?:[^"\\]|\\.)*";$/gm, 'const $1 = "";');
    if (code.length - lean.length < 100_000) throw new Error("three.js keeps its shader chunks otherwise than before");
    return { code: lean, map: null };
  },
};

export default defineConfig({
  base: "./",
  build: {
    outDir: PAGES,
    emptyOutDir: true,
    target: "es2022",
    // The content-security policy allows no inline script and no data: font.
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
    chunkSizeWarningLimit: 700,
  },
  // Workers are modules: what they decode with is loaded when it is needed.
  worker: { format: "es" },
  // zarrita offers to load codecs of numcodecs; src/viewer/data/blosc.ts stands for the one that clouds need.
  resolve: {
    alias: Object.fromEntries(
      ["blosc", "lz4", "zstd"].map((name) => [
        `numcodecs/${name}`,
        new URL("src/viewer/data/no-codec.ts", import.meta.url).pathname,
      ]),
    ),
  },
  server: { proxy: { "/v1": process.env.SPECIMAP_URL ?? "http://127.0.0.1:8000" } },
  plugins: [
    withoutShaderChunks,
    VitePWA({
      registerType: "prompt",
      injectRegister: null,
      manifest: {
        name: "Specimap",
        short_name: "Specimap",
        description: "Photos and spectra of a specimen, in three dimensions. For research use only.",
        start_url: "./",
        display: "standalone",
        background_color: "#101418",
        theme_color: "#101418",
        icons: [
          { src: "icons/icon-192.png", sizes: "192x192", type: "image/png" },
          { src: "icons/icon-512.png", sizes: "512x512", type: "image/png", purpose: "any maskable" },
        ],
      },
      workbox: {
        // The pages alone: nothing that the service answers is kept in a cache of the browser.
        globPatterns: ["**/*.{js,css,html,png,svg,webmanifest}"],
        navigateFallback: "index.html",
        navigateFallbackDenylist: [/^\/(v1|docs|redoc|openapi|healthz|readyz|metrics|static-offline-docs)/],
        inlineWorkboxRuntime: true,
      },
    }),
  ],
  test: { include: ["src/**/*.test.{ts,tsx}"] },
});
