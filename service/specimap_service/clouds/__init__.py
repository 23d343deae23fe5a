"""Clouds: arrays, spectra, pictures, labels and exports."""
