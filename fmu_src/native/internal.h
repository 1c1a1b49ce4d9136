/* What all files of the FMU share. Other code of the process, the C library and other FMUs among it, has
   functions of the same names: those of the FMU are static, but those of the standard and `differentiate`,
   which carry the prefix of a program that has the FMU as sources. */
#ifndef INTERNAL_H
#define INTERNAL_H

#define INTERNAL static

#if defined FMI3_FUNCTION_PREFIX
#define PREFIX FMI3_FUNCTION_PREFIX
#elif defined FMI2_FUNCTION_PREFIX
#define PREFIX FMI2_FUNCTION_PREFIX
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

/* The real part of what is compared: numbers are complex where the engine is compiled for derivatives. */
#define RE(x) (x)

#endif
