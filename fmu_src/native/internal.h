/* Declarations for all files of the FMU. The C library, other FMUs and the rest of the process may have functions of
   the same names. Therefore the FMU's functions are static, except those of the standard, `twodof_differentiate`,
   `twodof_span` and `twodof_evaluations`. A program that links the FMU's sources chooses a prefix for these names. */
#ifndef INTERNAL_H
#define INTERNAL_H

#include "model.h"

#define INTERNAL static

#if defined __FAST_MATH__ || defined _M_FP_FAST || (defined __FINITE_MATH_ONLY__ && __FINITE_MATH_ONLY__)
#error "compile without -ffast-math, -ffinite-math-only and /fp:fast: they remove the checks for NaN and inf"
#endif

/* The prefix, by the rules of the standard's headers; older headers have no override. */
#if FMI == 3
#if defined FMI3_FUNCTION_PREFIX && !defined FMI3_OVERRIDE_FUNCTION_PREFIX
#define PREFIX FMI3_FUNCTION_PREFIX
#elif defined FMI3_ACTUAL_FUNCTION_PREFIX
#define PREFIX FMI3_ACTUAL_FUNCTION_PREFIX
#endif
#elif defined FMI2_FUNCTION_PREFIX && !defined FMI2_OVERRIDE_FUNCTION_PREFIX
#define PREFIX FMI2_FUNCTION_PREFIX
#elif defined FMI2_ACTUAL_FUNCTION_PREFIX
#define PREFIX FMI2_ACTUAL_FUNCTION_PREFIX
#endif

#ifdef PREFIX
#define PASTE(a, b) a##b
#define JOIN(a, b) PASTE(a, b)
#define PREFIXED(name) JOIN(PREFIX, name)
#else
#define PREFIXED(name) name
#endif

#if defined __GNUC__ && !defined _WIN32
#define HIDDEN __attribute__((visibility("hidden")))
#else
#define HIDDEN
#endif

/* Argument for a rank of J⁺ that its singular values give. */
enum { ANY_RANK = -1 };

/* Real part of a number in a comparison; numbers are complex if the engine is compiled for derivatives. */
#define RE(x) (x)

#endif
