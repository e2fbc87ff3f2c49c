"""How problems, solvers, solutions and checks show themselves in notebooks: tables in HTML, mathematics in LaTeX."""
