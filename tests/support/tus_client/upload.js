// Uploads a file with tus-js-client, as the tablet's page does: node upload.js ENDPOINT ACQUISITION ROLE FILE CHUNK_BYTES
// The key comes in the environment variable KEY. Prints one JSON object.
import fs from "node:fs";
import path from "node:path";
import * as tus from "tus-js-client";

const [endpoint, acquisition, role, file, chunk] = process.argv.slice(2);
const answers = [];
const upload = new tus.Upload(fs.createReadStream(file), {
  endpoint,
  chunkSize: Number(chunk) || Infinity,
  retryDelays: [0, 100, 300, 1000, 1000, 1000],
  headers: { Authorization: `Bearer ${process.env.KEY}` },
  metadata: { acquisition, role, filename: path.basename(file), filetype: "application/octet-stream" },
  onAfterResponse: (request, response) => {
    answers.push([request.getMethod(), response.getStatus(), response.getHeader("Specimap-Verdict") ?? null]);
  },
  onError: (error) => {
    console.log(JSON.stringify({ error: String(error), answers }));
    process.exit(1);
  },
  onSuccess: () => {
    console.log(JSON.stringify({ url: upload.url, answers }));
    // A request that was answered before its body ended keeps its connection until the server gives that up.
    process.exit(0);
  },
});
upload.start();
