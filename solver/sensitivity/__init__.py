"""How errors of parameters spread to results: derivatives, Monte Carlo, FAST and Sobol indices of any function.

A function takes parameters (n, d), one set a row, and gives results (n, k). What its parameters scatter by is told as
`Normal` or `Uniform`.
"""
