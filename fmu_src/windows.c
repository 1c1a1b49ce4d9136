/* Functions that mingw's headers expect in a library of mingw. A library for Windows is linked with Windows' own C
   runtime only, because zig would compile mingw's library first, for a minute. */
#include <stdarg.h>
#include <stdio.h>

int vsnprintf(char *buffer, size_t size, const char *format, va_list arguments)
{
    const unsigned options = _CRT_INTERNAL_PRINTF_STANDARD_SNPRINTF_BEHAVIOR;
    return __stdio_common_vsprintf(options, buffer, size, format, NULL, arguments);
}

int snprintf(char *buffer, size_t size, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    const int length = vsnprintf(buffer, size, format, arguments);
    va_end(arguments);
    return length;
}
