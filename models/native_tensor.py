"""Spline tables in CasADi's C code: the same sums with loops of constant length, in a third of the time of its general routine."""

from __future__ import annotations

import re

_HEAD = re.compile(
    r"^void casadi_nd_boor_eval\(casadi_real\* ret, casadi_int n_dims, const casadi_real\* all_knots, const casadi_int\* offset, "
    r"const casadi_int\* all_degree, const casadi_int\* strides, const casadi_real\* c, casadi_int m, const casadi_real\* all_x, "
    r"const casadi_int\* lookup_mode, casadi_int\* iw, casadi_real\* w\) \{\n.*?^\}\n",
    re.MULTILINE | re.DOTALL,
)
_CALL = "CASADI_PREFIX(nd_boor_eval)("

# Number of arguments, components and degrees are constants at every call, which inlining turns into straight code.  An argument
# inside a cell has one basis spline of degree 0 that is not zero: the recursion keeps to the terms that come from it, in the order of
# the general routine, whose other terms add exact zeros.  At the first knot both give the weights 1, 0, ...  Knots between cells,
# arguments outside, NaN, degrees above 3 and more than three arguments go to the general routine.
_QUICK = """
static inline __attribute__((always_inline)) void rw_boor_eval(casadi_real *ret, casadi_int n_dims, const casadi_real *all_knots,
    const casadi_int *offset, const casadi_int *all_degree, const casadi_int *strides, const casadi_real *c, casadi_int m,
    const casadi_real *all_x, const casadi_int *lookup_mode, casadi_int *iw, casadi_real *w) {
  casadi_real boor[3][4];
  const casadi_real *first = c;
  int quick = n_dims >= 1 && n_dims <= 3;
  for (int a = 0; quick && a < n_dims; ++a) quick = all_degree[a] >= 1 && all_degree[a] <= 3;
  if (quick) {
    #pragma GCC unroll 3
    for (int a = 0; a < n_dims; ++a) {
      const casadi_int n = all_degree[a], count = offset[a + 1] - offset[a];
      const casadi_real x = all_x[a], *k = all_knots + offset[a];
      casadi_int at = casadi_low(x, k + n, count - 2 * n, lookup_mode[a]);
      if (at > count - 2 * n - 2) at = count - 2 * n - 2;
      k += at;
      if (!(x >= k[n] && x <= k[n + 1]) || (x == k[n] && (k[n - 1] < x || (at == 0 && k[0] < x)))) { quick = 0; break; }
      boor[a][n] = 1.0;
      #pragma GCC unroll 4
      for (int d = 1; d <= n; ++d) {
        #pragma GCC unroll 4
        for (int i = n - d; i <= n; ++i) {
          casadi_real b = 0.0, width = k[i + d] - k[i];
          if (i > n - d && width) b = (x - k[i]) * boor[a][i] / width;
          width = k[i + d + 1] - k[i + 1];
          if (i < n && width) b += (k[i + d + 1] - x) * boor[a][i + 1] / width;
          boor[a][i] = b;
        }
      }
      first += at * (a ? strides[a] : m);
    }
  }
  if (!quick) { casadi_nd_boor_eval(ret, n_dims, all_knots, offset, all_degree, strides, c, m, all_x, lookup_mode, iw, w); return; }
  const casadi_int n1 = n_dims > 1 ? all_degree[1] : 0, n2 = n_dims > 2 ? all_degree[2] : 0;
  #pragma GCC unroll 4
  for (int i2 = 0; i2 <= n2; ++i2) {
    const casadi_real outer = n_dims > 2 ? boor[2][i2] : 1.0;
    #pragma GCC unroll 4
    for (int i1 = 0; i1 <= n1; ++i1) {
      const casadi_real middle = n_dims > 1 ? outer * boor[1][i1] : 1.0;
      const casadi_real *row = first + (n_dims > 2 ? i2 * strides[2] : 0) + (n_dims > 1 ? i1 * strides[1] : 0);
      #pragma GCC unroll 4
      for (int i0 = 0; i0 <= all_degree[0]; ++i0) {
        const casadi_real weight = middle * boor[0][i0];
        for (casadi_int j = 0; j < m; ++j) ret[j] += weight * row[i0 * m + j];
      }
    }
  }
}
"""


def quicker(source: str) -> str:
    """CasADi's C code with its spline tables evaluated by loops of constant length: the same numbers, bit by bit.

    Code without spline tables, or whose general routine is not the one known here, is returned as it is.
    """
    found = _HEAD.search(source)
    if found is None or _CALL not in source:
        return source
    head, rest = source[: found.end()], source[found.end() :]
    return head + _QUICK + rest.replace(_CALL, "rw_boor_eval(")
