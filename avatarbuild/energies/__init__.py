"""One file an equation group: linear energies give (A, b), others residual and Jacobian."""
