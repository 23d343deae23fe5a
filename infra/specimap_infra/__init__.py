"""What the API and the workers share: settings, database, storage, job queue, logs. Pulls no 3D vision package."""
