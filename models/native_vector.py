"""C text that every lane program begins with: vector types, masks, selections, elementary functions."""

from __future__ import annotations

import math
from collections.abc import Sequence

from models.native_spline import literal

_VECTOR_MATH = {  # what the GNU C library offers for whole vectors, by version; at most 4 units in the last place
    (2, 22): ("log",),
    (2, 35): (
        "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "erf", "log1p", "expm1",
    ),
}  # fmt: skip
_VECTOR_MATH_2 = {(2, 22): ("pow",), (2, 35): ("atan2", "hypot")}

_PROLOGUE = """
#include <math.h>
#define LANES {lanes}
#define EACH_LANE _Pragma("omp simd")
typedef double L __attribute__((vector_size(8 * LANES)));
typedef long long M __attribute__((vector_size(8 * LANES)));
typedef long long i64;
#define INLINE static inline __attribute__((always_inline, unused))
#define PART static __attribute__((noinline))
INLINE L lane_all(double a) {{ L r; for (int l = 0; l < LANES; l++) r[l] = a; return r; }}
INLINE L lane_choose(M m, L a, L b) {{ return (L)((m & (M)a) | (~m & (M)b)); }}
INLINE L lane_pick(M m, L a) {{ return (L)(m & (M)a); }}
INLINE L lane_number(M m) {{ return lane_pick(m, lane_all(1.0)); }}
INLINE L lane_fabs(L a) {{ return (L)((M)a & 0x7fffffffffffffffLL); }}
INLINE L lane_copysign(L a, L b) {{ return (L)(((M)a & 0x7fffffffffffffffLL) | ((M)b & ~0x7fffffffffffffffLL)); }}
INLINE L lane_sign(L a) {{ return lane_choose(a < 0.0, lane_all(-1.0), lane_choose(a > 0.0, lane_all(1.0), a)); }}
INLINE M lane_bad(L a) {{ return ((M)a & 0x7ff0000000000000LL) == 0x7ff0000000000000LL; }}
INLINE M lane_nan(L a) {{ return ((M)a & 0x7fffffffffffffffLL) > 0x7ff0000000000000LL; }}
INLINE int lane_any(M m) {{ i64 any = 0; for (int l = 0; l < LANES; l++) any |= m[l]; return any != 0; }}
INLINE L lane_rows(const double *a, const i64 *row, i64 stride) {{
  L r; for (int l = 0; l < LANES; l++) r[l] = a[row[l] * stride]; return r;
}}
INLINE L lane_table(const double *table, const i64 *at, i64 width) {{
  double r[LANES]; L c; EACH_LANE for (int l = 0; l < LANES; l++) r[l] = table[at[l] * width]; __builtin_memcpy(&c, r, sizeof c); return c;
}}
#define LIBM(f) INLINE L lane_##f(L a) {{ \\
  double x[LANES], y[LANES]; __builtin_memcpy(x, &a, sizeof a); \\
  EACH_LANE for (int l = 0; l < LANES; l++) y[l] = f(x[l]); \\
  L r; __builtin_memcpy(&r, y, sizeof r); return r; }}
#define LIBM2(f) INLINE L lane_##f(L a, L b) {{ \\
  double x[LANES], z[LANES], y[LANES]; __builtin_memcpy(x, &a, sizeof a); __builtin_memcpy(z, &b, sizeof b); \\
  EACH_LANE for (int l = 0; l < LANES; l++) y[l] = f(x[l], z[l]); \\
  L r; __builtin_memcpy(&r, y, sizeof r); return r; }}
"""

# The smaller and the greater of two; `least` and `most` for a second one that is a number for certain.  Compilers do not find the
# instruction of the processor behind the selection of bits, and reading its header takes a fifth of a second: only where it is used.
_EXTREMES = """
#if LANES == 8 && defined(__AVX512F__)
#include <immintrin.h>
#define FIRST_IF_NAN(r, a, b) (L)_mm512_mask_mov_pd(r, _mm512_cmp_pd_mask((__m512d)b, (__m512d)b, _CMP_UNORD_Q), (__m512d)a)
INLINE L lane_least(L a, L b) { return (L)_mm512_min_pd((__m512d)a, (__m512d)b); }
INLINE L lane_most(L a, L b) { return (L)_mm512_max_pd((__m512d)a, (__m512d)b); }
INLINE L lane_fmin(L a, L b) { return FIRST_IF_NAN((__m512d)lane_least(a, b), a, b); }
INLINE L lane_fmax(L a, L b) { return FIRST_IF_NAN((__m512d)lane_most(a, b), a, b); }
#else
INLINE L lane_least(L a, L b) { return lane_choose(a < b, a, b); }
INLINE L lane_most(L a, L b) { return lane_choose(a > b, a, b); }
INLINE L lane_fmin(L a, L b) { return lane_choose((a < b) | (b != b), a, b); }
INLINE L lane_fmax(L a, L b) { return lane_choose((a > b) | (b != b), a, b); }
#endif
"""

# Sine and cosine share their reduction, so that the compiler computes it once for both: x - n pi/2 in four pieces, three of them of 33 bits
# (exact products for n < 2^20), then the Taylor series (remainder below 1e-16 on |r| <= pi/4).  Larger arguments and NaN go to libm.
_TRIGONOMETRY = """
INLINE L lane_turn(L x, M *quadrant) {{
  L n = (x * 0x1.45f306dc9c883p-1 + 0x1.8p52) - 0x1.8p52;
  *quadrant = (M)(n + 0x1.8p52);
  return (((x - n * 0x1.921fb544p0) - n * 0x1.0b4611a6p-34) - n * 0x1.3198a2ep-69) - n * 0x1.b839a252049c1p-104;
}}
INLINE L lane_sin_near(L r) {{
  L z = r * r;
  return r + r * z * {sin};
}}
INLINE L lane_cos_near(L r) {{
  L z = r * r;
  return 1.0 + z * {cos};
}}
PART L lane_sin_far(L x, L y, M far) {{ for (int l = 0; l < LANES; l++) if (far[l]) y[l] = sin(x[l]); return y; }}
PART L lane_cos_far(L x, L y, M far) {{ for (int l = 0; l < LANES; l++) if (far[l]) y[l] = cos(x[l]); return y; }}
INLINE L lane_sin(L x) {{
  M q, far = ~(lane_fabs(x) < 1e5);
  L r = lane_turn(x, &q), s = lane_sin_near(r), c = lane_cos_near(r);
  L y = (L)((M)lane_choose((q & 1) != 0, c, s) ^ ((q & 2) << 62));
  return __builtin_expect(lane_any(far), 0) ? lane_sin_far(x, y, far) : y;
}}
INLINE L lane_cos(L x) {{
  M q, far = ~(lane_fabs(x) < 1e5);
  L r = lane_turn(x, &q), s = lane_sin_near(r), c = lane_cos_near(r);
  L y = (L)((M)lane_choose((q & 1) != 0, s, c) ^ (((q + 1) & 2) << 62));
  return __builtin_expect(lane_any(far), 0) ? lane_cos_far(x, y, far) : y;
}}
INLINE L lane_tan(L x) {{ return lane_sin(x) / lane_cos(x); }}
"""

# x = n log 2 + z with log 2 in two pieces (the first of 36 bits: exact products), the Taylor series on |z| <= log(2)/2 (remainder below
# 1e-17), and 2^n as two factors, so that results below the smallest normal number are right too.  NaN stays NaN.  Written out it costs
# half as much as a call of the vector library, which would save all vectors of its surroundings in memory.
_EXPONENTIAL = """
INLINE L lane_exp(L x) {{
  x = lane_choose(x > 710.0, lane_all(710.0), x);
  x = lane_choose(x < -750.0, lane_all(-750.0), x);
  L k = x * 0x1.71547652b82fep0 + 0x1.8p52, n = k - 0x1.8p52;
  M whole = (M)k - (M)lane_all(0x1.8p52), half = whole >> 1;
  L z = (x - n * 0x1.62e42fefa0000p-1) - n * 0x1.cf79abc9e3b3ap-40;
  L e = 1.0 + (z + z * z * {series});
  return e * (L)((half + 1023) << 52) * (L)((whole - half + 1023) << 52);
}}
"""


def _series(signs_and_factorials: Sequence[int]) -> str:
    """Horner form in z of sum z^k / factor_k."""
    text = literal(1.0 / signs_and_factorials[-1])
    for factor in reversed(signs_and_factorials[:-1]):
        text = f"({literal(1.0 / factor)} + z * {text})"
    return text


def prologue(lanes: int, unary: Sequence[str], binary: Sequence[str], *, fast: bool, extremes: bool) -> str:
    """Vector types and elementary functions of one and two arguments: those of the C library, one lane after the other.

    With `extremes` also the smaller and the greater of two.  With `fast` sine, cosine, tangent and the exponential are written out
    and the others come from the vector library where there is one.
    """
    text = [_PROLOGUE.format(lanes=lanes), _EXTREMES if extremes else ""]
    if fast:
        text.append("#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)\n")
        for table, arguments in ((_VECTOR_MATH, "double"), (_VECTOR_MATH_2, "double, double")):
            for (major, minor), names in table.items():
                text.append(f"#if __GLIBC_PREREQ({major}, {minor})\n")
                text += [f'extern double {n}({arguments}) __attribute__((simd("notinbranch"), const, nothrow));\n' for n in names]
                text.append("#endif\n")
        text.append("#endif\n")
        sines = [(-1) ** k * math.factorial(2 * k + 1) for k in range(1, 9)]
        cosines = [(-1) ** k * math.factorial(2 * k) for k in range(1, 10)]
        text.append(_TRIGONOMETRY.format(sin=_series(sines), cos=_series(cosines)))
        text.append(_EXPONENTIAL.format(series=_series([math.factorial(k) for k in range(2, 14)])))
    own = ("sin", "cos", "tan", "exp") if fast else ()
    text += [f"LIBM({name})\n" for name in unary if name not in own]
    text += [f"LIBM2({name})\n" for name in binary]
    return "".join(text)
