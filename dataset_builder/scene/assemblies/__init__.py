"""Steel of scenes: lattice, pile, pier and generated cages."""
