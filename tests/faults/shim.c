/* Counts what a process writes below a folder, and lets one call of it fail, or the process die in it.

Loaded by LD_PRELOAD: what Python, SQLite and other libraries call, whatever language they are written in. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <unistd.h>

enum { FAIL, DIE, FULL };

static char folder[4096], calls[1 << 16];
static long due_at = -1, count;
static int how;

void faults_arm(const char *below, long at, int mode) {
    snprintf(folder, sizeof folder, "%s", below);
    due_at = at;
    how = mode;
    count = 0;
    calls[0] = 0;
}

/* Names of the calls so far, parted by spaces. */
const char *faults_calls(void) { return calls; }

static int below(const char *path) {
    size_t n = strlen(folder);
    return n && !strncmp(path, folder, n) && (path[n] == '/' || !path[n]);
}

static int open_below(int fd) {
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, sizeof path - 1);
    if (n < 0) return 0;
    path[n] = 0;
    return below(path);
}

static void die(void) {
    kill(getpid(), SIGKILL);
    pause();
}

/* Whether this call is to fail; the process dies here unless the caller does half of the work first. */
static int due(const char *name, int takes_room, int halves) {
    long mine = count++;
    size_t used = strlen(calls);
    snprintf(calls + used, sizeof calls - used, "%s ", name);
    if (due_at < 0 || mine < due_at || (mine > due_at && how != FULL)) return 0;
    if (how == FULL && !takes_room) return 0;
    if (how == DIE && !halves) die();
    return 1;
}

#define REAL(type, name, ...)                         \
    static type (*real)(__VA_ARGS__);                 \
    if (!real) real = (type(*)(__VA_ARGS__))dlsym(RTLD_NEXT, name)

#define REFUSE(code)  \
    do {              \
        errno = code; \
        return -1;    \
    } while (0)

ssize_t write(int fd, const void *data, size_t size) {
    REAL(ssize_t, "write", int, const void *, size_t);
    if (open_below(fd) && due("write", 1, 1)) {
        if (how != DIE) REFUSE(ENOSPC);
        real(fd, data, size / 2);
        die();
    }
    return real(fd, data, size);
}

static ssize_t put(const char *name, int fd, const void *data, size_t size, off_t at) {
    ssize_t (*real)(int, const void *, size_t, off_t) =
        (ssize_t(*)(int, const void *, size_t, off_t))dlsym(RTLD_NEXT, name);
    if (open_below(fd) && due("write", 1, 1)) {
        if (how != DIE) REFUSE(ENOSPC);
        real(fd, data, size / 2, at);
        die();
    }
    return real(fd, data, size, at);
}

ssize_t pwrite(int fd, const void *data, size_t size, off_t at) { return put("pwrite", fd, data, size, at); }
ssize_t pwrite64(int fd, const void *data, size_t size, off_t at) { return put("pwrite64", fd, data, size, at); }

int fsync(int fd) {
    REAL(int, "fsync", int);
    if (open_below(fd) && due("fsync", 0, 0)) REFUSE(EIO);
    return real(fd);
}

int fdatasync(int fd) {
    REAL(int, "fdatasync", int);
    if (open_below(fd) && due("fsync", 0, 0)) REFUSE(EIO);
    return real(fd);
}

int rename(const char *from, const char *to) {
    REAL(int, "rename", const char *, const char *);
    if (below(to) && due("rename", 0, 0)) REFUSE(EIO);
    return real(from, to);
}

int unlink(const char *path) {
    REAL(int, "unlink", const char *);
    if (below(path) && due("unlink", 0, 0)) REFUSE(EIO);
    return real(path);
}

int mkdir(const char *path, mode_t mode) {
    REAL(int, "mkdir", const char *, mode_t);
    if (below(path) && due("mkdir", 1, 0)) REFUSE(ENOSPC);
    return real(path, mode);
}
