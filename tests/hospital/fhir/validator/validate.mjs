// Reads a FHIR R4 resource as JSON from standard input; prints what the standard's definitions say of it, as JSON.
import fhir from "fhir";

const { Fhir } = fhir;
let text = "";
for await (const part of process.stdin) text += part;
const validator = new Fhir();
const bundle = JSON.parse(text);
const resources = bundle.resourceType === "Bundle" ? [bundle, ...bundle.entry.map((entry) => entry.resource)] : [bundle];
const messages = resources.flatMap((resource) => validator.validate(resource).messages ?? []);
console.log(JSON.stringify(messages.filter((message) => message.severity !== "info")));
