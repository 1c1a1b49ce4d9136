/* Functions of the engine are not seen outside of the library: other libraries of the process, the C
   library and other FMUs among them, have functions of the same names. */
#ifndef INTERNAL_H
#define INTERNAL_H

#if defined __GNUC__ && !defined _WIN32
#define INTERNAL __attribute__((visibility("hidden")))
#else
#define INTERNAL
#endif

/* The real part of what is compared: numbers are complex where the engine is compiled for derivatives. */
#define RE(x) (x)

#endif
