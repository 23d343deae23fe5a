// panva's oidc-provider, a certified implementation, on loopback: node server.mjs PORT SETTINGS, a JSON object with
// jwks, algorithm, client_id, client_secret, redirect_uri, post_logout_redirect_uri and audience.
import Provider from "oidc-provider";

const [port, text] = process.argv.slice(2);
const given = JSON.parse(text);
const provider = new Provider(`http://127.0.0.1:${port}`, {
  jwks: given.jwks,
  cookies: { keys: ["for tests"] },
  clients: [
    {
      client_id: given.client_id,
      client_secret: given.client_secret,
      redirect_uris: [given.redirect_uri],
      post_logout_redirect_uris: [given.post_logout_redirect_uri],
      grant_types: ["authorization_code", "client_credentials"],
      response_types: ["code"],
      id_token_signed_response_alg: given.algorithm,
    },
  ],
  // Roles come in userinfo alone: so does everything with this library unless the claims are asked for by name.
  claims: { openid: ["sub"], roles: ["roles"] },
  scopes: ["openid", "roles"],
  findAccount: (_, id) => ({ accountId: id, claims: () => ({ sub: id, roles: [`specimap-${id}`] }) }),
  extraTokenClaims: () => ({ roles: ["specimap-classifier"] }),
  features: {
    devInteractions: { enabled: true },
    clientCredentials: { enabled: true },
    resourceIndicators: {
      enabled: true,
      defaultResource: () => undefined,
      getResourceServerInfo: (_, resource) => ({
        scope: "",
        audience: resource,
        accessTokenFormat: "jwt",
        accessTokenTTL: 300,
        jwt: { sign: { alg: given.algorithm } },
      }),
    },
  },
});
provider.listen(Number(port), "127.0.0.1", () => process.stdout.write("listening\n"));
