"""How the API is reached, and how long connections last."""

from __future__ import annotations

from pydantic import BaseModel, Field

from specimap_infra.settings.units import GIB


class ServerSettings(BaseModel):
    """The API and its connections."""

    host: str = Field(
        default="127.0.0.1", description="Address to listen on; anything but loopback needs a TLS proxy in front."
    )
    port: int = Field(default=8765, ge=0, le=65535, description="Port to listen on; 0 takes a free one.")
    public_url: str = Field(default="", description="How clients reach the service, where a proxy stands in front.")
    cors_origins: list[str] = Field(
        default_factory=list, description="Web origins that may call the API, as a JSON list."
    )
    rate_per_minute: int = Field(
        default=6000, ge=1, description="Requests a minute that a key may make, unless the key says otherwise."
    )
    session_hours: float = Field(
        default=12, gt=0, le=720, description="Hours after which a person who signed in on a page signs in again."
    )
    max_connections: int = Field(
        default=1000, ge=1, description="Connections that the API takes at a time; it raises its limit of open files."
    )
    max_connections_per_address: int = Field(
        default=900,
        ge=1,
        description="Connections of one address; a proxy has one address, and what is left serves health checks.",
    )
    max_streams_per_key: int = Field(
        default=100, ge=1, description="Streams of job events that one key may follow at a time, in each API process."
    )
    band_copies_bytes: int = Field(
        default=8 * GIB,
        ge=0,
        description="Most bytes of the copies in the scratch folder from which single bands of large results are read quickly; 0 makes none.",
    )
    head_seconds: float = Field(default=30, gt=0, description="Longest time that the head of a request may take.")
    keep_alive_seconds: float = Field(
        default=75,
        gt=0,
        description="How long a connection may wait for its next request; longer than a proxy keeps its own.",
    )
    silence_seconds: float = Field(
        default=60,
        gt=0,
        description="Silence in a body, or in the reading of an answer, after which a connection is closed.",
    )
