"""Parts that the API and the workers share: settings, database, storage, job queue, logs. No 3D vision package."""
