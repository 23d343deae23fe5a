"""Train on the points that somebody has labelled in one cloud, and label another: train_and_label.py TRAIN TARGET.

Address and key come from SPECIMAP_URL and SPECIMAP_KEY; the key needs the scopes read and label.
"""

import sys

import numpy as np
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from specimap_client import Client, Cloud


def tissue(cloud: Cloud) -> np.ndarray:
    """Points on the specimen, neither on a card nor saturated nor occluded, with a value in every good band."""
    return np.flatnonzero((cloud.flags & 1 > 0) & (cloud.flags & (2 | 8 | 32 | 128) == 0))


with Client() as client:
    train, target = (client.clouds.get(name) for name in sys.argv[1:3])
    if not np.allclose(train.wavelength_nm, target.wavelength_nm):
        sys.exit("The clouds have other bands than each other.")
    histology = train.label("histology")
    truth = histology.values()
    points = np.intersect1d(tissue(train), np.flatnonzero(truth))
    bands = np.intersect1d(train.good_bands, target.good_bands)
    model = make_pipeline(StandardScaler(), LogisticRegression(max_iter=1000))
    model.fit(train.spectra(indices=points, bands=bands).values, truth[points])

    found = np.zeros(target.points, np.uint8)
    for page in target.iter_spectra(indices=tissue(target), bands=bands):
        found[page.indices] = model.predict(page.values)
    made_by = {"name": "logistic regression", "version": "1", "trained_on": train.id}
    label = target.put_label("tissue", found, classes=histology.classes, made_by=made_by)
    print(f"{label.name}, version {label.version}: {np.count_nonzero(found)} of {target.points} points labelled")
