"""Evidence about modules of particles."""
