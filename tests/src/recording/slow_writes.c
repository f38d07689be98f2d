/* Slow writes: each call that writes to a recording (a file with the ending .mcap), or moves it to the disk, sleeps
 * first, for SINEW_SLOW_MS milliseconds. The number of these calls is in the file named by SINEW_SLOW_COUNT. Loaded
 * before the C library (LD_PRELOAD). */
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

static int64_t *count;
static long slow_ms;

__attribute__((constructor)) static void begin(void)
{
    const char *text = getenv("SINEW_SLOW_MS"), *path = getenv("SINEW_SLOW_COUNT");
    slow_ms = text ? atol(text) : 0;
    int file = path ? open(path, O_RDWR | O_CLOEXEC) : -1;
    void *page = file < 0 ? MAP_FAILED : mmap(NULL, sizeof *count, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    count = page == MAP_FAILED ? NULL : page;
    if (file >= 0) close(file);
}

static void sleep_for(int file)
{
    char link[64], name[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = readlink(link, name, sizeof name);
    if (length < 5 || memcmp(name + length - 5, ".mcap", 5)) return;
    if (count) __atomic_add_fetch(count, 1, __ATOMIC_RELAXED);
    struct timespec pause = {slow_ms / 1000, slow_ms % 1000 * 1000000};
    nanosleep(&pause, NULL);
}

ssize_t write(int file, const void *bytes, size_t length)
{
    sleep_for(file);
    return syscall(SYS_write, file, bytes, length);
}

ssize_t writev(int file, const struct iovec *parts, int many)
{
    sleep_for(file);
    return syscall(SYS_writev, file, parts, many);
}

ssize_t pwrite(int file, const void *bytes, size_t length, off_t at)
{
    sleep_for(file);
    return syscall(SYS_pwrite64, file, bytes, length, at);
}

ssize_t pwrite64(int file, const void *bytes, size_t length, off64_t at)
{
    sleep_for(file);
    return syscall(SYS_pwrite64, file, bytes, length, at);
}

int fsync(int file)
{
    sleep_for(file);
    return (int)syscall(SYS_fsync, file);
}

int fdatasync(int file)
{
    sleep_for(file);
    return (int)syscall(SYS_fdatasync, file);
}
