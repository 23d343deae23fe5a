"""Jobs over HTTP while workers, stages, machines and the API are killed at random; none may be lost."""
