/*
 * Lets a user-mode Linux kernel run where processors have larger registers than it knows (those of AMX, say).
 *
 * It sets its processes' registers by PTRACE_SETREGSET with the 2696 bytes that it has room for, and the host takes
 * all or nothing: EFAULT, and the kernel panics. Preloaded, this takes what is missing from the process itself.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/types.h>
#include <sys/uio.h>

#define STATE_MAX 65536 /* bytes; AMX has 11 008 */

static long (*original)(int, pid_t, void *, void *);

__attribute__((constructor)) static void find(void) { original = dlsym(RTLD_NEXT, "ptrace"); }

static long set_state(pid_t pid, void *kind, struct iovec *given) {
    static __thread char state[STATE_MAX] __attribute__((aligned(64)));
    struct iovec whole = {state, sizeof state};
    if (original(PTRACE_GETREGSET, pid, kind, &whole) != 0 || whole.iov_len < given->iov_len)
        return original(PTRACE_SETREGSET, pid, kind, given);
    memcpy(state, given->iov_base, given->iov_len);
    return original(PTRACE_SETREGSET, pid, kind, &whole);
}

long ptrace(enum __ptrace_request request, ...) {
    va_list arguments;
    va_start(arguments, request);
    pid_t pid = va_arg(arguments, pid_t);
    void *address = va_arg(arguments, void *), *data = va_arg(arguments, void *);
    va_end(arguments);
    if (request == PTRACE_SETREGSET && address == (void *)NT_X86_XSTATE)
        return set_state(pid, address, data);
    return original(request, pid, address, data);
}
