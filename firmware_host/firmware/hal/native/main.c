/* evlcp-board: the driver board as a process, on a pseudo-terminal or a socket.

   Chips fall due by the clock of the host but are worked off in portions of a millisecond; a record carries the
   tick at which its chip was due. Timing of the real kind is the business of the other boards. */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <netdb.h>
#include <poll.h>
#include <pty.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "board.h"
#include "crc32.h"

struct options {
    const char *listen;
    const char *leds;
    const char *flash;
    const char *link;
    uint64_t baud; /* 0: as fast as it goes */
    uint64_t id;
};

struct line {
    int listener; /* -1: none */
    int fd;       /* -1: no host */
    bool once;    /* end with the host */
};

static volatile sig_atomic_t ended;

static void on_signal(int number)
{
    (void)number;
    ended = 1;
}

static void die(const char *what)
{
    fprintf(stderr, "evlcp-board: %s: %s\n", what, strerror(errno));
    exit(1);
}

static void die_of_file(const char *path)
{
    fprintf(stderr, "evlcp-board: %s: the flash file cannot be used: %s\n", path, strerror(errno));
    exit(3);
}

/* A whole number from 0 to `most`. */
static uint64_t number(const char *option, const char *text, int base, uint64_t most)
{
    char *end;
    errno = 0;
    unsigned long long value = strtoull(text, &end, base);
    if (errno != 0 || *text < '0' || *text > '9' || *end != '\0' || value > most) {
        fprintf(stderr, "evlcp-board: %s: %s, expected a whole number from 0 to %llu\n", option, text,
                (unsigned long long)most);
        exit(2);
    }
    return value;
}

static uint64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (uint64_t)t.tv_sec * 1000000000u + (uint64_t)t.tv_nsec;
}

static void nonblocking(int fd)
{
    int flags = fcntl(fd, F_GETFL);
    if (flags < 0 || fcntl(fd, F_SETFL, flags | O_NONBLOCK) < 0)
        die("fcntl");
}

/* Makes room for a name of ours; a file that is something else stays. */
static void remove_old(const char *path, mode_t type)
{
    struct stat found;
    if (lstat(path, &found) != 0)
        return;
    if ((found.st_mode & S_IFMT) != type) {
        errno = EEXIST;
        die(path);
    }
    unlink(path);
}

static int listen_unix(const char *path)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    if (strlen(path) >= sizeof address.sun_path) {
        errno = ENAMETOOLONG;
        die(path);
    }
    memcpy(address.sun_path, path, strlen(path) + 1u);
    int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    remove_old(path, S_IFSOCK);
    if (fd < 0 || bind(fd, (struct sockaddr *)&address, sizeof address) < 0 || listen(fd, 1) < 0)
        die(path);
    return fd;
}

static int listen_tcp(const char *host_port)
{
    char host[256];
    const char *colon = strrchr(host_port, ':');
    if (colon == NULL || (size_t)(colon - host_port) >= sizeof host) {
        errno = EINVAL;
        die(host_port);
    }
    (void)number("--listen tcp:HOST:PORT", colon + 1, 10, 65535u);
    memcpy(host, host_port, (size_t)(colon - host_port));
    host[colon - host_port] = '\0';
    struct addrinfo hints = {.ai_family = AF_INET, .ai_socktype = SOCK_STREAM, .ai_flags = AI_PASSIVE};
    struct addrinfo *found;
    if (getaddrinfo(host, colon + 1, &hints, &found) != 0) {
        errno = EADDRNOTAVAIL;
        die(host_port);
    }
    int on = 1;
    int fd = socket(found->ai_family, found->ai_socktype | SOCK_CLOEXEC, 0);
    if (fd < 0 || setsockopt(fd, SOL_SOCKET, SO_REUSEADDR, &on, sizeof on) < 0 ||
        bind(fd, found->ai_addr, found->ai_addrlen) < 0 || listen(fd, 1) < 0)
        die(host_port);
    freeaddrinfo(found);
    return fd;
}

static int open_pty(const char *link_path)
{
    int master;
    int slave;
    char name[256];
    struct termios raw;
    if (openpty(&master, &slave, name, NULL, NULL) < 0 || tcgetattr(slave, &raw) < 0)
        die("openpty");
    cfmakeraw(&raw);
    if (tcsetattr(slave, TCSANOW, &raw) < 0)
        die("tcsetattr");
    /* The slave stays open here, so that a host that leaves does not hang up the line. */
    if (link_path != NULL) {
        remove_old(link_path, S_IFLNK);
        if (symlink(name, link_path) < 0)
            die(link_path);
    }
    printf("listening on %s\n", link_path != NULL ? link_path : name);
    return master;
}

static struct line open_line(const struct options *o)
{
    struct line line = {.listener = -1, .fd = -1, .once = false};
    if (strcmp(o->listen, "pty") == 0) {
        line.fd = open_pty(o->link);
    } else if (strncmp(o->listen, "fd:", 3) == 0) {
        line.fd = atoi(o->listen + 3);
        line.once = true;
    } else if (strncmp(o->listen, "unix:", 5) == 0) {
        line.listener = listen_unix(o->listen + 5);
    } else if (strncmp(o->listen, "tcp:", 4) == 0) {
        line.listener = listen_tcp(o->listen + 4);
    } else {
        errno = EINVAL;
        die(o->listen);
    }
    if (line.listener >= 0) {
        nonblocking(line.listener);
        printf("listening on %s\n", o->listen);
    }
    if (line.fd >= 0)
        nonblocking(line.fd);
    fflush(stdout);
    return line;
}

static void hang_up(struct line *line)
{
    if (line->once)
        ended = 1;
    close(line->fd);
    line->fd = -1;
}

static void record_to_file(void *context, const uint8_t record[NATIVE_RECORD_BYTES])
{
    if (fwrite(record, NATIVE_RECORD_BYTES, 1, context) != 1)
        die("LED record");
}

static void load_flash(struct native *board, const char *path)
{
    FILE *file = fopen(path, "rb");
    if (file == NULL && errno == ENOENT)
        return; /* a new board */
    struct stat found;
    if (file == NULL || fstat(fileno(file), &found) < 0)
        die_of_file(path);
    if (!S_ISREG(found.st_mode) || found.st_size != (off_t)sizeof board->flash) {
        fprintf(stderr, "evlcp-board: %s: not a flash file of %zu bytes\n", path, sizeof board->flash);
        exit(3);
    }
    if (fread(board->flash, sizeof board->flash, 1, file) != 1)
        die_of_file(path);
    fclose(file);
    native_reset(board);
}

/* A new file takes the place of the old one when it is whole: a kill or a power failure leaves one of the two. */
static void store_flash(const struct native *board, const char *path)
{
    char name[4096];
    struct stat old;
    int length = snprintf(name, sizeof name, "%s.new", path);
    if (length < 0 || (size_t)length >= sizeof name) {
        errno = ENAMETOOLONG;
        die_of_file(path);
    }
    int fd = open(name, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0666);
    if (fd < 0 || (stat(path, &old) == 0 && fchmod(fd, old.st_mode & 07777u) < 0))
        die_of_file(name);
    const uint8_t *bytes = board->flash[0];
    for (size_t at = 0; at < sizeof board->flash;) {
        ssize_t count = write(fd, bytes + at, sizeof board->flash - at);
        if (count < 0 && errno != EINTR)
            die_of_file(name);
        at += count > 0 ? (size_t)count : 0u;
    }
    if (fsync(fd) < 0 || close(fd) < 0 || rename(name, path) < 0)
        die_of_file(name);
    char *slash = strrchr(name, '/');
    if (slash != NULL)
        slash[1] = '\0';
    int folder = open(slash != NULL ? name : ".", O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (folder >= 0) {
        (void)fsync(folder); /* not every file system can */
        close(folder);
    }
}

/* Tells the slots' content apart: each SAVE has another header. Without the headers' own CRC: a CRC over bytes
   and their CRC is the same for all bytes. */
static uint32_t headers(const struct native *board)
{
    uint32_t crc = 0u;
    for (uint32_t i = 0; i < EVLCP_SLOTS; i++)
        crc = evlcp_crc32(crc, board->flash[i], EVLCP_SLOT_HEADER_BYTES - 4u);
    return crc;
}

static struct options parse(int argc, char **argv)
{
    struct options o = {.listen = "pty"};
    for (int i = 1; i < argc; i++) {
        if (i + 1 == argc) {
            fprintf(stderr, "usage: evlcp-board [--listen pty|unix:PATH|tcp:HOST:PORT|fd:N] [--link PATH]"
                            " [--leds FILE] [--flash FILE] [--baud N] [--id N]\n");
            exit(2);
        }
        const char *name = argv[i++];
        if (strcmp(name, "--listen") == 0)
            o.listen = argv[i];
        else if (strcmp(name, "--link") == 0)
            o.link = argv[i];
        else if (strcmp(name, "--leds") == 0)
            o.leds = argv[i];
        else if (strcmp(name, "--flash") == 0)
            o.flash = argv[i];
        else if (strcmp(name, "--baud") == 0)
            o.baud = number(name, argv[i], 10, UINT64_MAX);
        else if (strcmp(name, "--id") == 0)
            o.id = number(name, argv[i], 0, UINT64_MAX);
        else {
            fprintf(stderr, "evlcp-board: unknown option %s\n", name);
            exit(2);
        }
    }
    return o;
}

/* Bytes that a line of `baud` has room for since the last call; what is not used is lost, as on a line. */
struct throttle {
    uint64_t baud;
    uint64_t last_ns;
    double room;
};

static size_t allowed(struct throttle *t, uint64_t ns, size_t most)
{
    if (t->baud == 0u)
        return most;
    t->room += (double)(ns - t->last_ns) * 1e-10 * (double)t->baud;
    t->last_ns = ns;
    if (t->room > 4096.0)
        t->room = 4096.0;
    return t->room < (double)most ? (size_t)t->room : most;
}

static void read_line(struct native *board, struct line *line, struct throttle *t, uint64_t ns)
{
    uint8_t bytes[2048];
    size_t most = allowed(t, ns, sizeof bytes);
    if (most == 0u)
        return;
    ssize_t count = read(line->fd, bytes, most);
    if (count > 0) {
        if (t->baud != 0u)
            t->room -= (double)count;
        native_input(board, bytes, (size_t)count);
    } else if (count == 0 || (errno != EAGAIN && errno != EINTR)) {
        hang_up(line);
    } else if (t->baud != 0u && t->room > 2.0) {
        t->room = 2.0; /* an idle line saves nothing up */
    }
}

static void write_line(struct native *board, struct line *line, struct throttle *t, uint64_t ns)
{
    size_t most = allowed(t, ns, board->output_length);
    if (board->output_length == 0u && t->baud != 0u && t->room > 2.0)
        t->room = 2.0;
    if (most == 0u)
        return;
    ssize_t count = write(line->fd, board->output, most);
    if (count > 0) {
        if (t->baud != 0u)
            t->room -= (double)count;
        uint8_t sent[sizeof board->output];
        (void)native_output(board, sent, (size_t)count);
    } else if (errno != EAGAIN && errno != EINTR) {
        hang_up(line);
    }
}

/* A host that finds another one connected is hung up on; one whose forerunner has left takes its place. */
static bool has_left(const struct line *line)
{
    struct pollfd left = {.fd = line->fd, .events = POLLRDHUP};
    return poll(&left, 1, 0) > 0;
}

static void take_host(struct line *line)
{
    if (line->fd >= 0 && has_left(line))
        return; /* first all that it has sent is read */
    int fd = accept(line->listener, NULL, NULL);
    if (fd < 0)
        return;
    if (line->fd >= 0 && !has_left(line)) {
        close(fd);
        return;
    }
    if (line->fd >= 0)
        hang_up(line);
    nonblocking(fd);
    line->fd = fd;
}

int main(int argc, char **argv)
{
    static struct native board;
    const struct options o = parse(argc, argv);
    struct sigaction action = {.sa_handler = on_signal};
    sigaction(SIGINT, &action, NULL);
    sigaction(SIGTERM, &action, NULL);
    signal(SIGPIPE, SIG_IGN);
    /* An emulator that a command started does not outlive it. */
    if (strncmp(o.listen, "fd:", 3) == 0)
        prctl(PR_SET_PDEATHSIG, SIGTERM);

    native_init(&board);
    for (int i = 0; i < 8; i++)
        board.unique_id[11 - i] = (uint8_t)(o.id >> 8 * i);
    static char target[PATH_MAX];
    const char *flash_file = o.flash;
    if (o.flash != NULL) {
        load_flash(&board, o.flash);
        if (realpath(o.flash, target) != NULL)
            flash_file = target; /* a link stays one */
        store_flash(&board, flash_file); /* a place that takes no SAVE is known now */
    }
    FILE *leds = NULL;
    if (o.leds != NULL) {
        leds = fopen(o.leds, "wb");
        if (leds == NULL)
            die(o.leds);
        board.record = record_to_file;
        board.record_context = leds;
    }
    native_reset(&board);
    struct line line = open_line(&o);
    struct throttle in = {.baud = o.baud, .last_ns = now_ns()};
    struct throttle out = in;
    uint64_t began = now_ns();
    uint32_t saved = headers(&board);

    while (!ended) {
        bool throttled = in.baud != 0u && line.fd >= 0;
        struct pollfd wait = {.fd = line.fd >= 0 ? line.fd : line.listener,
                              .events = throttled ? 0 : POLLIN};
        struct timespec most = {.tv_nsec = 20000000};
        if (board.period != 0u || board.core.test.on)
            most.tv_nsec = 1000000;
        if (board.output_length != 0u || throttled)
            most.tv_nsec = 100000;
        int ready = ppoll(&wait, 1, &most, NULL);
        if (ready < 0 && errno != EINTR)
            die("poll");
        uint64_t ns = now_ns();
        if (line.fd >= 0 && (ready > 0 || throttled))
            read_line(&board, &line, &in, ns);
        if (line.listener >= 0)
            take_host(&line);
        native_run(&board, (ns - began) / (1000000000u / NATIVE_TICK_HZ));
        /* Before the answer to a SAVE goes out, the slots are in the file. */
        uint32_t flash = headers(&board);
        if (flash != saved && flash_file != NULL)
            store_flash(&board, flash_file);
        saved = flash;
        if (line.fd >= 0)
            write_line(&board, &line, &out, ns);
        else
            board.output_length = 0u; /* nobody listens */
        if (leds != NULL && board.period == 0u && fflush(leds) != 0)
            die(o.leds);
    }
    if (leds != NULL && fclose(leds) != 0)
        die(o.leds);
    if (strncmp(o.listen, "unix:", 5) == 0)
        unlink(o.listen + 5);
    if (o.link != NULL)
        unlink(o.link);
    return 0;
}
