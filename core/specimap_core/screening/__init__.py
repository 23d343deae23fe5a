"""Files judged as they arrive, one by one, so that a bad one is retaken while the specimen is still there."""
