"""Newton's method and the interior point method: barrier, filter, restoration, scaling, verdict."""
