"""What joins the API to a hospital: study contexts, orders, DICOM objects out and in."""
