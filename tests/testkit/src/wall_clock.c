/* A wall clock that is ahead by SINEW_WALL_AHEAD_S seconds, for a process that loads this before the C library
 * (LD_PRELOAD). It replaces the function of the kernel's vDSO, so it holds for callers that pass the C library by, too.
 * All other clocks stay unchanged. Where the kernel does not let a process do that, it ends with exit code 97. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <link.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/auxv.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

static long ahead_s;

static int read_clock(clockid_t clock, struct timespec *now)
{
    long result = syscall(SYS_clock_gettime, clock, now);
    int is_wall = clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE || clock == CLOCK_TAI;
    if (!result && is_wall) now->tv_sec += ahead_s;
    return (int)result;
}

static int replace(void)
{
    uintptr_t base = getauxval(AT_SYSINFO_EHDR), page = (uintptr_t)sysconf(_SC_PAGESIZE), length = 0;
    void *vdso = base ? dlopen("linux-vdso.so.1", RTLD_LAZY | RTLD_NOLOAD) : NULL;
    uint8_t *code = vdso ? dlsym(vdso, "__vdso_clock_gettime") : NULL;
    if (vdso && !code) code = dlsym(vdso, "__kernel_clock_gettime");
    if (!code) return 0;
#if defined(__x86_64__)
    uint8_t jump[12] = {0x48, 0xb8, 0, 0, 0, 0, 0, 0, 0, 0, 0xff, 0xe0}; /* mov rax, target; jmp rax */
    size_t at = 2;
#elif defined(__aarch64__)
    uint8_t jump[16] = {0x50, 0, 0, 0x58, 0, 0x02, 0x1f, 0xd6}; /* ldr x16, target; br x16 */
    size_t at = 8;
#else
    uint8_t jump[sizeof(void *)];
    size_t at = 0;
    return 0;
#endif
    void *target = (void *)read_clock;
    memcpy(jump + at, &target, sizeof target);
    /* The kernel changes the rights of the whole mapping or of nothing. */
    const ElfW(Ehdr) *header = (const void *)base;
    const ElfW(Phdr) *segment = (const void *)(base + header->e_phoff);
    for (int i = 0; i < header->e_phnum; i++) {
        uintptr_t end = segment[i].p_offset + segment[i].p_memsz;
        if (segment[i].p_type == PT_LOAD && end > length) length = end;
    }
    length = (length + page - 1) & ~(page - 1);
    if (mprotect((void *)base, length, PROT_READ | PROT_WRITE | PROT_EXEC)) return 0;
    memcpy(code, jump, sizeof jump);
    __builtin___clear_cache((char *)code, (char *)code + sizeof jump);
    return !mprotect((void *)base, length, PROT_READ | PROT_EXEC);
}

__attribute__((constructor)) static void begin(void)
{
    const char *text = getenv("SINEW_WALL_AHEAD_S");
    if (!text) return;
    ahead_s = atol(text);
    if (!replace()) _exit(97);
}
