"""The linear program of `squared_speeds`, solved by HiGHS itself or stated by cvxpy."""

import warnings
from typing import TYPE_CHECKING

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, require_choice

if TYPE_CHECKING:
    import scipy.sparse as sparse

SOLVERS = ("highs", "cvxpy", "cvxpy:NAME")
TOLERANCE = 1e-10  # of HiGHS, primal and dual


def greatest(
    rows: "sparse.csr_matrix", bound: np.ndarray, least: np.ndarray, solver: str = "highs"
) -> np.ndarray | None:
    """Solve max sum_i b_i with rows b <= 1, least <= b <= bound; None if there is no solution.

    The program is made anew for every motion: the size of `rows` differs from motion to motion.

    Args:
        rows: (r, g).
        bound: (g,), largest values of b.
        least: (g,), smallest values of b.
        solver: "highs", its own interface; "cvxpy", the same program stated by cvxpy, which takes
            two seconds to import, and solved by HiGHS; "cvxpy:NAME", solved by another one.

    Returns:
        b (g,). "highs" and "cvxpy" return equal bits.
    """
    of_cvxpy = cvxpy_solver(solver)
    return _by_cvxpy(rows, bound, least, of_cvxpy) if of_cvxpy else _by_highs(rows, bound, least)


def cvxpy_solver(solver: str) -> str:
    """Return the name of cvxpy's solver that `solver` of `greatest` means; "" for HiGHS itself."""
    kind, _, name = solver.partition(":")
    if kind == "cvxpy":
        import cvxpy as cp  # takes two seconds

        installed = tuple(cp.installed_solvers())
        return str(require_choice("solver of cvxpy", name.upper() or cp.HIGHS, installed))
    require_choice("solver", solver, SOLVERS)
    return ""


def _by_highs(rows: "sparse.csr_matrix", bound: np.ndarray, least: np.ndarray) -> np.ndarray | None:
    """Return b (g,), see `greatest`."""
    import highspy  # not needed by planning without timing

    columns = rows.tocsc()
    program = highspy.HighsLp()
    program.num_row_, program.num_col_ = columns.shape
    program.col_cost_ = np.full(len(bound), -1.0)  # HiGHS minimises
    program.col_lower_, program.col_upper_ = least, bound
    program.row_lower_ = np.full(columns.shape[0], -np.inf)
    program.row_upper_ = np.ones(columns.shape[0])
    program.a_matrix_.format_ = highspy.MatrixFormat.kColwise
    program.a_matrix_.start_ = columns.indptr
    program.a_matrix_.index_ = columns.indices
    program.a_matrix_.value_ = columns.data

    highs = highspy.Highs()
    highs.silent()
    for kind in ("primal", "dual"):
        highs.setOptionValue(f"{kind}_feasibility_tolerance", TOLERANCE)
    highs.passModel(program)
    highs.run()
    if highs.getModelStatus() != highspy.HighsModelStatus.kOptimal:
        return None
    return np.array(highs.getSolution().col_value)


def _by_cvxpy(
    rows: "sparse.csr_matrix", bound: np.ndarray, least: np.ndarray, solver: str
) -> np.ndarray | None:
    """Return b (g,) by one of cvxpy's solvers, see `greatest`."""
    import cvxpy as cp

    b = cp.Variable(len(bound), bounds=[least, bound])
    problem = cp.Problem(cp.Maximize(cp.sum(b)), [rows @ b <= 1.0])
    options = {}
    if solver == cp.HIGHS:
        names = (f"{kind}_feasibility_tolerance" for kind in ("primal", "dual"))
        options["highs_options"] = dict.fromkeys(names, TOLERANCE)
    try:
        with warnings.catch_warnings():
            # inaccurate solutions are accepted here: the limits are checked afterwards
            warnings.simplefilter("ignore", UserWarning)
            problem.solve(solver=solver, **options)
    except cp.SolverError as error:
        raise InvalidInputError(
            f"cvxpy's {solver} failed: {error}; give another solver, such as 'highs'"
        ) from error
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) or b.value is None:
        return None
    return np.asarray(b.value)
