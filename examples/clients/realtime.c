/* A real-time client of `ecaxis serve` in C: a sine of 1 Hz on the first axis. It needs only what
 * docs/server.md says.
 *
 *   gcc -O2 -o realtime realtime.c -lm
 *   ./realtime SOCKET [SECONDS] */
#define _GNU_SOURCE
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

enum { ROWS_AT = 2, ROW_WORDS, ROWS, CYCLE_NS, WRITTEN, NEXT_NS, TEXT_AT, TEXT_BYTES };
enum { AXES_AT = 2, AXIS_WORDS, AXES, SEQUENCE, COUNTER };
#define AMPLITUDE 2.0
#define LAST 4096 /* the set-points that wait for their row */

static int server;

static void fail(const char *what) {
    perror(what);
    exit(1);
}

/* Sends a request, and reads its answer; file descriptors come with it. */
static void ask(const char *line, int *fds) {
    static char answer[1 << 16];
    char control[CMSG_SPACE(2 * sizeof(int))];
    size_t have = 0;
    if (send(server, line, strlen(line), MSG_NOSIGNAL) < 0)
        fail("send");
    while (have < sizeof answer - 1) {
        struct iovec bytes = {answer + have, sizeof answer - 1 - have};
        struct msghdr message = {.msg_iov = &bytes, .msg_iovlen = 1, .msg_control = control, .msg_controllen = sizeof control};
        ssize_t count = recvmsg(server, &message, MSG_CMSG_CLOEXEC);
        if (count <= 0)
            fail("recvmsg");
        struct cmsghdr *header = CMSG_FIRSTHDR(&message);
        if (fds && header && header->cmsg_type == SCM_RIGHTS)
            memcpy(fds, CMSG_DATA(header), 2 * sizeof(int));
        have += (size_t)count;
        answer[have] = 0;
        if (strchr(answer, '\n'))
            break;
    }
    if (!strstr(answer, "\"ok\":true")) {
        fprintf(stderr, "%s%s", line, answer);
        exit(1);
    }
}

static uint64_t *map(int fd, int protection) {
    struct stat file;
    if (fstat(fd, &file))
        fail("fstat");
    void *base = mmap(NULL, (size_t)file.st_size, protection, MAP_SHARED | MAP_POPULATE, fd, 0);
    if (base == MAP_FAILED)
        fail("mmap");
    return base;
}

static double number(uint64_t bits) {
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

int main(int count, char **arguments) {
    if (count < 2)
        return fprintf(stderr, "usage: %s SOCKET [SECONDS]\n", arguments[0]), 2;
    double seconds = count > 2 ? atof(arguments[2]) : 60;
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    strncpy(address.sun_path, arguments[1], sizeof address.sun_path - 1);
    server = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (connect(server, (struct sockaddr *)&address, sizeof address))
        fail("connect");
    int fds[2] = {-1, -1};
    ask("{\"op\": \"await\", \"bus\": \"op\"}\n", NULL);
    ask("{\"op\": \"take\", \"name\": \"realtime.c\", \"ttl_ms\": 500}\n", NULL);
    ask("{\"op\": \"enable\", \"axis\": \"x\", \"wait\": true}\n", NULL);
    ask("{\"op\": \"area\"}\n", fds);
    volatile uint64_t *samples = map(fds[0], PROT_READ), *commands = map(fds[1], PROT_READ | PROT_WRITE);
    if (memcmp((void *)samples, "ECAXSMPL", 8) || memcmp((void *)commands, "ECAXCMDS", 8) || samples[1] != 1 || commands[1] != 1)
        return fprintf(stderr, "another layout\n"), 1;
    mlockall(MCL_CURRENT | MCL_FUTURE);

    /* The word of the first axis' target position, from the description. */
    char *text = strndup((char *)samples + samples[TEXT_AT], samples[TEXT_BYTES]);
    char *word = strstr(text, ".target_position\"");
    word = word ? strstr(word, "\"word\":") : NULL;
    if (!word)
        return fprintf(stderr, "no target position\n"), 1;
    uint64_t target = strtoull(word + strlen("\"word\":"), NULL, 10);

    double cycle_s = (double)samples[CYCLE_NS] * 1e-9, begin = NAN, phase = 0;
    static double sets[LAST];
    static uint64_t rows[LAST];
    uint64_t row = __atomic_load_n(&samples[WRITTEN], __ATOMIC_ACQUIRE);
    uint64_t written = 0, used = 0, skipped = 0, renewed = 0, cycles = (uint64_t)(seconds / cycle_s), end = row + cycles;
    memset(rows, 0xff, sizeof rows);
    printf("running\n");
    fflush(stdout);
    int pauses = 0;
    while (row < end) {
        uint64_t now = __atomic_load_n(&samples[WRITTEN], __ATOMIC_ACQUIRE);
        if (now == row) {
            struct timespec pause = {0, 20000};
            nanosleep(&pause, NULL);
            if (++pauses > 50000)
                return fprintf(stderr, "no cycle for a second: the server has ended, or the bus is down\n"), 1;
            continue;
        }
        pauses = 0;
        skipped += now - row - 1;
        /* The rows since then: does each have the set-point that was written for it? */
        for (uint64_t n = row; n < now; n++) {
            uint64_t at = samples[ROWS_AT] + n % samples[ROWS] * samples[ROW_WORDS];
            double position = number(samples[at + target]);
            if (isnan(begin))
                begin = position;
            used += rows[n % LAST] == n && fabs(position - sets[n % LAST]) < 1e-9;
        }
        phase += 2 * M_PI * cycle_s * (double)(now - row);
        row = now;
        /* The set for the next cycle; its row has the number `row`. */
        double position = begin + AMPLITUDE * (1 - cos(phase));
        rows[row % LAST] = row;
        sets[row % LAST] = position;
        uint64_t sequence = commands[SEQUENCE], bits, at = commands[AXES_AT];
        memcpy(&bits, &position, sizeof bits);
        __atomic_store_n(&commands[SEQUENCE], sequence + 1, __ATOMIC_RELAXED);
        __atomic_thread_fence(__ATOMIC_RELEASE);
        commands[COUNTER] = ++written;
        commands[at] = 1;
        commands[at + 1] = bits;
        __atomic_store_n(&commands[SEQUENCE], sequence + 2, __ATOMIC_RELEASE);
        if (row - renewed > 100) {
            static const char renew[] = "{\"op\": \"renew\"}\n";
            char answers[4096];
            if (send(server, renew, sizeof renew - 1, MSG_NOSIGNAL | MSG_DONTWAIT) < 0)
                fail("send");
            while (recv(server, answers, sizeof answers, MSG_DONTWAIT) > 0) {
            }
            renewed = row;
        }
    }
    printf("written %lu used %lu (%.3f %%) late %lu refused %lu cycles skipped %lu\n", written, used,
           100.0 * (double)used / (double)written, commands[10], commands[11], skipped);
    return 0;
}
