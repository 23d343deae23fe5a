"""Sign-in with an identity provider by OpenID Connect: loaded only where one is configured."""
