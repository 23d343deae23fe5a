/// <reference types="vitest/config" />
import { defineConfig } from "vite";
import { VitePWA } from "vite-plugin-pwa";

/** Where the service looks for the built pages. */
const PAGES = "../service/specimap_service/pages";

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
  server: { proxy: { "/v1": process.env.SPECIMAP_URL ?? "http://127.0.0.1:8000" } },
  plugins: [
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
