/* Emulates a kernel before 6.16 that does not know the socket option SO_PASSRIGHTS. Loaded before the C library (LD_PRELOAD).
 * All other options stay unchanged. */
#define _GNU_SOURCE
#include <errno.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <unistd.h>

#if defined(__sparc__)
#define PASSRIGHTS 92
#else
#define PASSRIGHTS 83
#endif

int setsockopt(int socket, int level, int name, const void *value, socklen_t length)
{
    if (level == SOL_SOCKET && name == PASSRIGHTS) {
        errno = ENOPROTOOPT;
        return -1;
    }
    return (int)syscall(SYS_setsockopt, socket, level, name, value, length);
}
