"""The places of the specimen at which a result is checked, and the photos that see them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats, Ints
from specimap_core.cloud import CloudPoints, Flag
from specimap_core.surface.photo_consistency import Photographs, choose_views, frontal_views
from specimap_core.surface.raycast import RayCaster
from specimap_core.surface.settings import RefineSettings

PLACES = 400
ABOVE_MM = 0.2


@dataclass(frozen=True)
class Sites:
    """P mesh vertices ``points`` (P, 3) mm with unit ``normals`` (P, 3); ``used`` (P, V): photos that the surface was
    refined on there, of those that see the place unhidden, ``seen`` (P, V); ``sigma_mm`` (P,), stated of the cloud's
    point there."""

    points: Floats
    normals: Floats
    used: NDArray[np.bool_]
    seen: NDArray[np.bool_]
    sigma_mm: Floats


def sites_of(points: CloudPoints, caster: RayCaster, photographs: Photographs, settings: RefineSettings) -> Sites:
    """Sites spread evenly over the specimen as the cube shows it: each stands for as many spectra."""
    vertices, sigma = _spread(points, caster)
    mesh = caster.mesh
    place, normal = mesh.vertices[vertices].astype(float), mesh.normals[vertices].astype(float)
    photos = len(photographs.poses)
    used = seen = np.zeros((0, photos), bool)
    if len(vertices):
        least = settings.least_cosine
        used = _named(choose_views(caster, vertices, photographs, settings.views, least), photos)
        seen = _named(frontal_views(caster, vertices, photographs, photos, least), photos)
    return Sites(place, normal, used, seen, sigma)


def _named(views: Ints, photos: int) -> NDArray[np.bool_]:
    """Which of the ``photos`` the rows of ``views`` (P, k) name: (P, photos)."""
    named = np.zeros((len(views), photos), bool)
    row, rank = np.nonzero(views >= 0)
    named[row, views[row, rank]] = True
    return named


def tangents(normals: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors across each of the normals (P, 3)."""
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    one = np.cross(helper, normals)
    one /= np.maximum(np.linalg.norm(one, axis=1, keepdims=True), 1e-12)
    return one, np.cross(normals, one)


def _spread(points: CloudPoints, caster: RayCaster) -> tuple[Ints, Floats]:
    """Vertices next to every n-th of the specimen's points in rows and columns, and the points' standard deviations."""
    specimen = np.flatnonzero(points.flags & Flag.SPECIMEN)
    cell = max(1, int(np.sqrt(len(specimen) / PLACES)))
    pixels = points.hsi_pixel[specimen].astype(int)
    chosen = specimen[(pixels % cell == cell // 2).all(1)]
    normals = points.normal[chosen].astype(float)
    hits = caster.cast(points.xyz[chosen] + ABOVE_MM * normals, -normals)
    met = np.flatnonzero(hits.hit)
    shares = np.column_stack([1 - hits.barycentric.sum(1), hits.barycentric])[met]
    vertices, first = np.unique(caster.mesh.triangles[hits.triangle[met], shares.argmax(1)], return_index=True)
    return vertices.astype(np.int64), points.sigma_mm[chosen[met[first]]].astype(float)
