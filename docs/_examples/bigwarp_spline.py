"""A landmark table of BigWarp, matched by the thin-plate spline that BigWarp uses and by a flow."""

from pathlib import Path

import numpy
from scipy.interpolate import RBFInterpolator

from codegen.registration import register
from codegen.registration.certificate import certify
from codegen.registration.formats import read_landmarks

pairs = read_landmarks(Path(__file__).with_name("bigwarp_landmarks.csv"))
x, y = numpy.meshgrid(numpy.arange(160.0), numpy.arange(160.0))

# BigWarp fits the map from the fixed image to the moving one, and inverts it where it needs the other.
spline = RBFInterpolator(pairs.fixed, pairs.moving, kernel="thin_plate_spline", degree=1)
u, v = spline(numpy.column_stack([x.ravel(), y.ravel()])).T.reshape(2, *x.shape)
(u_y, u_x), (v_y, v_x) = numpy.gradient(u), numpy.gradient(v)
folded = int((u_x * v_y - u_y * v_x <= 0).sum())
print(f"spline: landmarks to {abs(spline(pairs.fixed) - pairs.moving).max():.0e}, {folded} pixels folded")

certificate = certify(register(pairs, x.shape))
print(f"flow: landmarks to {certificate.residual_max:.0e}, {certificate.folded} pixels folded")
print(f"flow: there and back to {certificate.round_trip:.0e}")
