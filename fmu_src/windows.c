/* Functions that mingw's headers expect in a library of mingw. A library for Windows is linked with Windows' own C
   runtime only, because zig would compile mingw's library first, for a minute. */
#include <stdarg.h>
#include <stdio.h>

/* The compiler calls this function at the begin of a function with more than a page of local variables, with their size
   in rax. It touches each page in order, because Windows adds pages to a stack one at a time. It changes no register. */
__asm__(".globl ___chkstk_ms\n"
        "___chkstk_ms:\n"
        "  pushq %rcx\n"
        "  pushq %rax\n"
        "  leaq 24(%rsp), %rcx\n"
        "1: cmpq $0x1000, %rax\n"
        "  jb 2f\n"
        "  subq $0x1000, %rcx\n"
        "  orq $0, (%rcx)\n"
        "  subq $0x1000, %rax\n"
        "  jmp 1b\n"
        "2: subq %rax, %rcx\n"
        "  orq $0, (%rcx)\n"
        "  popq %rax\n"
        "  popq %rcx\n"
        "  ret\n");

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
