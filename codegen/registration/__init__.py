"""Registration of images by landmarks: maps that do not fold, their exact inverses, and certificates of both.

Points are (x, y) in pixels, x to the right and y down, with the origin at the centre of the top-left pixel; arrays of
points have shape (n, 2). Maps lead from the moving to the fixed image. Points of volumes are (x, y, z) in the
coordinates of a `codegen.registration.grid.Grid`.
"""

from codegen.registration.alignment import Alignment, align
from codegen.registration.certificate import Certificate, certify
from codegen.registration.grid import Frame
from codegen.registration.linear import AlignmentChoice, chosen_alignment
from codegen.registration.maps import Registration
from codegen.registration.noise import Outliers, SigmaEstimate, choose_sigma, estimate_sigma, find_outliers
from codegen.registration.pairs import LandmarkPairs, flipped
from codegen.registration.register import LeaveOneOut, leave_one_out, register
from codegen.registration.warp import WarpReport, displacement_field, warp, warp_reported, write_field

__all__ = [
    "Alignment",
    "AlignmentChoice",
    "Certificate",
    "Frame",
    "LandmarkPairs",
    "LeaveOneOut",
    "Outliers",
    "Registration",
    "SigmaEstimate",
    "WarpReport",
    "align",
    "certify",
    "choose_sigma",
    "chosen_alignment",
    "displacement_field",
    "estimate_sigma",
    "find_outliers",
    "flipped",
    "leave_one_out",
    "register",
    "warp",
    "warp_reported",
    "write_field",
]
