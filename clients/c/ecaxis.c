/* ecaxis for C, see ecaxis.h and docs/server.md. Nothing that a server sends is trusted. */
#ifndef _GNU_SOURCE
#define _GNU_SOURCE
#endif
#include "ecaxis.h"

#include <errno.h>
#include <fcntl.h>
#include <locale.h>
#include <math.h>
#include <poll.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

/* The longest message of a server, and the deepest nesting of its objects. */
#define MAX_MESSAGE ((size_t)16 << 20)
#define MAX_DEPTH 32
/* The requests whose outcomes are kept. */
#define REQUESTS 64
#define MAX_LINE 4096
#define MAX_NAMES (MAX_LINE - 256)
/* The time for the answer to a question, in s. */
#define ANSWER_S 10.0
#define NO_CYCLE_NS 1000000000u
#define RENEWAL 0

typedef _Atomic uint64_t word;

/* JSON: a value is the text between two pointers, once `skip_value` has checked it. */

typedef struct json {
    const char *at, *end;
} json;

static const char *skip_space(const char *at, const char *end) {
    while (at < end && strchr(" \t\r\n", *at) && *at)
        at++;
    return at;
}

static const char *skip_string(const char *at, const char *end) {
    if (at == end || *at++ != '"')
        return NULL;
    for (; at < end && *at != '"'; at++) {
        if (*at == '\\')
            at++;
        else if ((unsigned char)*at < 0x20)
            return NULL;
    }
    return at < end ? at + 1 : NULL;
}

/* Returns the end of the value at `at`, or NULL if there is none. */
static const char *skip_value(const char *at, const char *end, int depth) {
    at = skip_space(at, end);
    if (at == end || depth > MAX_DEPTH)
        return NULL;
    if (*at == '"')
        return skip_string(at, end);
    if (*at == '{' || *at == '[') {
        char close = *at == '{' ? '}' : ']';
        at = skip_space(at + 1, end);
        if (at < end && *at == close)
            return at + 1;
        while (at) {
            if (close == '}') {
                at = skip_string(skip_space(at, end), end);
                at = at ? skip_space(at, end) : NULL;
                if (!at || at == end || *at++ != ':')
                    return NULL;
            }
            at = skip_value(at, end, depth + 1);
            at = at ? skip_space(at, end) : NULL;
            if (!at || at == end || (*at != ',' && *at != close))
                return NULL;
            if (*at++ == close)
                return at;
        }
        return NULL;
    }
    const char *begin = at;
    while (at < end && *at && strchr("+-.0123456789abcdefghijklmnopqrstuvwxyzE", *at))
        at++;
    return at > begin ? at : NULL;
}

/* Finds a value of an object. Its text is empty if there is none. */
static json member(json object, const char *key) {
    size_t length = strlen(key);
    const char *at = object.at, *end = object.end;
    for (at = at < end && *at == '{' ? at + 1 : end; at < end;) {
        at = skip_space(at, end);
        const char *name = at, *after = skip_string(at, end);
        if (!after)
            break;
        json value;
        value.at = skip_space(skip_space(after, end) + 1, end);
        value.end = skip_value(value.at, end, 0);
        if (!value.end)
            break;
        if ((size_t)(after - name) == length + 2 && !memcmp(name + 1, key, length))
            return value;
        at = skip_space(value.end, end) + 1;
    }
    return (json){end, end};
}

/* Takes the next element of an array, whose rest is `array`. */
static bool next_element(json *array, json *element) {
    const char *at = array->at, *end = array->end;
    if (at >= end || (*at != '[' && *at != ','))
        return false;
    element->at = skip_space(at + 1, end);
    element->end = skip_value(element->at, end, 0);
    if (!element->end)
        return false;
    array->at = skip_space(element->end, end);
    return true;
}

/* Returns the locale in which numbers have a point. */
static locale_t c_locale(void) {
    static _Atomic(locale_t) kept;
    locale_t known = atomic_load(&kept), nothing = (locale_t)0;
    if (!known) {
        known = newlocale(LC_ALL_MASK, "C", nothing);
        if (!atomic_compare_exchange_strong(&kept, &nothing, known)) {
            freelocale(known);
            known = nothing;
        }
    }
    return known;
}

static double to_number(json value) {
    char text[64], *after;
    size_t length = (size_t)(value.end - value.at);
    if (length == 0 || length >= sizeof text || !strchr("-0123456789", *value.at))
        return NAN;
    memcpy(text, value.at, length);
    text[length] = 0;
    double number = strtod_l(text, &after, c_locale());
    return *after ? NAN : number;
}

static bool is_true(json value) {
    return value.end - value.at == 4 && !memcmp(value.at, "true", 4);
}

/* Copies a text, cut to `size` bytes between characters; empty if the value is not a text. */
static void to_text(json value, char *text, size_t size) {
    size_t length = 0;
    unsigned long high = 0;
    const char *at = value.at + 1, *end = value.end - 1;
    text[0] = 0;
    if (value.end - value.at < 2 || *value.at != '"')
        return;
    while (at < end) {
        char bytes[5] = {*at++, 0, 0, 0, 0};
        if (bytes[0] == '\\' && at < end) {
            static const char from[] = "nrtbf", to[] = "\n\r\t\b\f";
            char kind = *at++;
            const char *known = kind ? strchr(from, kind) : NULL;
            bytes[0] = known ? to[known - from] : kind;
            if (kind == 'u' && end - at >= 4) {
                char digits[5] = {at[0], at[1], at[2], at[3], 0};
                unsigned long code = strtoul(digits, NULL, 16);
                at += 4;
                if ((code & 0xfc00) == 0xd800) {
                    high = code;
                    continue;
                }
                if ((code & 0xfc00) == 0xdc00)
                    code = high ? 0x10000 + ((high & 0x3ff) << 10) + (code & 0x3ff) : '?';
                high = 0;
                int more = code < 0x80 ? 0 : code < 0x800 ? 1 : code < 0x10000 ? 2 : 3;
                static const unsigned char first[] = {0, 0xc0, 0xe0, 0xf0};
                for (int n = more; n > 0; n--, code >>= 6)
                    bytes[n] = (char)(0x80 | (code & 0x3f));
                bytes[0] = (char)(first[more] | code);
                bytes[0] = bytes[0] ? bytes[0] : '?';
            }
        } else if (bytes[0] & 0x80) {
            for (int n = 1; n < 4 && at < end && (*at & 0xc0) == 0x80; n++)
                bytes[n] = *at++;
        }
        if (length + strlen(bytes) >= size)
            break;
        memcpy(text + length, bytes, strlen(bytes) + 1);
        length += strlen(bytes);
    }
}

/* Writes a text as JSON. Returns false if it does not fit. */
static bool quote(char *to, size_t size, const char *text) {
    size_t length = 0;
    if (size < 3)
        return false;
    to[length++] = '"';
    for (; *text; text++) {
        unsigned char byte = (unsigned char)*text;
        char part[8] = {*text, 0};
        if (byte == '"' || byte == '\\' || byte < 0x20)
            snprintf(part, sizeof part, "\\u%04x", byte);
        if (length + strlen(part) + 2 > size)
            return false;
        memcpy(to + length, part, strlen(part));
        length += strlen(part);
    }
    memcpy(to + length, "\"", 2);
    return true;
}

/* The connection. */

typedef struct request {
    int64_t id; /* 0: free */
    bool done, ok;
    ecaxis_error error;
} request;

struct ecaxis {
    int socket;
    int descriptors[2];
    int64_t ids, asked; /* the last number; the question that is being answered */
    bool lost, owns, virtual_time;
    double lease_s, renewed;
    char *input; /* received bytes */
    size_t have, room;
    char *answer; /* to the last question */
    size_t answer_length;
    request requests[REQUESTS];
    ecaxis_error error, lease_error;
    int axes;
    ecaxis_axis_info *infos;
};

static double now_s(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

__attribute__((format(printf, 5, 6))) static void set_error(ecaxis_error *error, const char *code, const char *device,
                                                            const char *help, const char *cause, ...) {
    va_list values;
    va_start(values, cause);
    memset(error->code, 0, sizeof error->code);
    snprintf(error->code, sizeof error->code, "%s", code);
    if (device)
        snprintf(error->device, sizeof error->device, "%s", device);
    vsnprintf(error->cause, sizeof error->cause, cause, values);
    snprintf(error->help, sizeof error->help, "%s", help);
    va_end(values);
}

static int lose(ecaxis *m, const char *code, const char *cause) {
    m->lost = true;
    set_error(&m->error, code, NULL, "attach again", "%s", cause);
    return -1;
}

static void begin_step(ecaxis *m, const char *step, const char *device) {
    if (m->lost)
        return;
    memset(&m->error, 0, sizeof m->error);
    snprintf(m->error.step, sizeof m->error.step, "%s", step);
    snprintf(m->error.device, sizeof m->error.device, "%s", device ? device : "");
}

static bool send_all(ecaxis *m, const char *bytes, size_t length) {
    double end = now_s() + ANSWER_S;
    while (length) {
        ssize_t sent = send(m->socket, bytes, length, MSG_NOSIGNAL | MSG_DONTWAIT);
        if (sent > 0) {
            bytes += sent;
            length -= (size_t)sent;
            continue;
        }
        struct pollfd wait = {.fd = m->socket, .events = POLLOUT};
        if (errno == EINTR)
            continue;
        if (errno != EAGAIN || now_s() > end)
            return lose(m, "lost", errno == EAGAIN ? "the server reads nothing" : strerror(errno)) == 0;
        poll(&wait, 1, 100);
    }
    return true;
}

static void read_error(json answer, ecaxis_error *error) {
    json object = member(answer, "error");
    to_text(member(object, "code"), error->code, sizeof error->code);
    to_text(member(object, "message"), error->cause, sizeof error->cause);
    to_text(member(object, "help"), error->help, sizeof error->help);
    if (!error->code[0])
        set_error(error, "protocol", NULL, "", "the server reports an error without a code");
}

/* Takes one message: an answer, or an event, which nothing here needs. */
static int take_message(ecaxis *m, json message) {
    json ok = member(message, "ok");
    if (ok.at == ok.end)
        return 0;
    json given = member(message, "id");
    double number = to_number(given);
    /* A line that the server cannot read has an answer without a number. */
    int64_t id = given.at == given.end ? m->ids : number >= 0 && number < 9e15 ? (int64_t)number : -1;
    if (id == RENEWAL) {
        if (!is_true(ok) && m->owns) {
            m->owns = false;
            memset(&m->lease_error, 0, sizeof m->lease_error);
            snprintf(m->lease_error.step, sizeof m->lease_error.step, "keep the lease");
            read_error(message, &m->lease_error);
        }
        return 0;
    }
    if (id == m->asked && !m->answer) {
        m->answer_length = (size_t)(message.end - message.at);
        m->answer = malloc(m->answer_length + 1);
        if (!m->answer)
            return lose(m, "system", "out of memory");
        memcpy(m->answer, message.at, m->answer_length);
        m->answer[m->answer_length] = 0;
        return 0;
    }
    for (request *r = m->requests; r < m->requests + REQUESTS; r++) {
        if (r->id == id && !r->done) {
            r->done = true;
            r->ok = is_true(ok);
            if (!r->ok)
                read_error(message, &r->error);
        }
    }
    return 0;
}

static void keep_descriptors(ecaxis *m, struct msghdr *header) {
    for (struct cmsghdr *part = CMSG_FIRSTHDR(header); part; part = CMSG_NXTHDR(header, part)) {
        if (part->cmsg_level != SOL_SOCKET || part->cmsg_type != SCM_RIGHTS)
            continue;
        size_t count = (part->cmsg_len - CMSG_LEN(0)) / sizeof(int);
        for (size_t n = 0; n < count; n++) {
            int fd;
            memcpy(&fd, CMSG_DATA(part) + n * sizeof fd, sizeof fd);
            int place = m->descriptors[0] < 0 ? 0 : 1;
            if (m->descriptors[place] >= 0)
                close(fd);
            else
                m->descriptors[place] = fd;
        }
    }
}

/* Receives what is there, for at most `timeout_s`. */
static int receive(ecaxis *m, double timeout_s) {
    struct pollfd wait = {.fd = m->socket, .events = POLLIN};
    if (m->lost)
        return -1;
    int ready = poll(&wait, 1, timeout_s > 0 ? (int)(timeout_s * 1e3) + 1 : 0);
    if (ready <= 0)
        return ready < 0 && errno != EINTR ? lose(m, "system", strerror(errno)) : 0;
    if (m->room - m->have < 65536) {
        char *more = m->room < MAX_MESSAGE ? realloc(m->input, m->room * 2 + 131072) : NULL;
        if (!more)
            return lose(m, "protocol", "a message of the server is too long");
        m->input = more;
        m->room = m->room * 2 + 131072;
    }
    union {
        char bytes[CMSG_SPACE(2 * sizeof(int))];
        struct cmsghdr align;
    } control;
    struct iovec bytes = {m->input + m->have, m->room - m->have};
    struct msghdr header = {
        .msg_iov = &bytes, .msg_iovlen = 1, .msg_control = control.bytes, .msg_controllen = sizeof control.bytes};
    ssize_t count = recvmsg(m->socket, &header, MSG_CMSG_CLOEXEC | MSG_DONTWAIT);
    if (count < 0 && (errno == EAGAIN || errno == EINTR))
        return 0;
    if (count <= 0)
        return lose(m, "lost", count ? strerror(errno) : "the server has closed the connection");
    keep_descriptors(m, &header);
    char *begin = m->input, *searched = m->input + m->have, *line;
    m->have += (size_t)count;
    char *end = m->input + m->have;
    while ((line = memchr(searched, '\n', (size_t)(end - searched)))) {
        json message = {skip_space(begin, line), line};
        const char *after = skip_value(message.at, line, 0);
        if (!after || *message.at != '{' || skip_space(after, line) != line)
            return lose(m, "protocol", "a message of the server is not a JSON object");
        message.end = after;
        if (take_message(m, message))
            return -1;
        begin = searched = line + 1;
    }
    m->have = (size_t)(end - begin);
    memmove(m->input, begin, m->have);
    return 0;
}

/* Sends a request with the inside of an object. Returns false if the connection is lost. */
static bool send_request(ecaxis *m, int64_t id, const char *op, bool wait, const char *keys) {
    char line[MAX_LINE + 128];
    int length = snprintf(line, sizeof line, "{\"id\":%lld,\"op\":\"%s\"%s%s%s}\n", (long long)id, op,
                          wait ? ",\"wait\":true" : "", keys[0] ? "," : "", keys);
    if (m->lost)
        return false;
    if (length < 0 || (size_t)length >= sizeof line || strchr(keys, '\n')) {
        set_error(&m->error, "bad_request", NULL, "", "a request is longer than %d bytes, or has a new line", MAX_LINE);
        return false;
    }
    return send_all(m, line, (size_t)length);
}

/* Renews the lease if a third of its time is over. */
static void renew(ecaxis *m) {
    double now = now_s();
    if (m->owns && now - m->renewed > m->lease_s / 3) {
        m->renewed = now;
        send_request(m, RENEWAL, "renew", false, "");
    }
}

/* Asks and waits for the answer, which is in `m->answer` then. */
static int ask(ecaxis *m, const char *op, const char *keys, double timeout_s) {
    double end = now_s() + timeout_s;
    free(m->answer);
    m->answer = NULL;
    m->asked = ++m->ids;
    if (!send_request(m, m->asked, op, false, keys))
        return -1;
    while (!m->answer) {
        double rest = end - now_s();
        if (rest <= 0) {
            m->asked = -1;
            set_error(&m->error, "timeout", NULL, "", "the server has not answered within %g s", timeout_s);
            return -1;
        }
        renew(m);
        if (receive(m, rest < 0.05 ? rest : 0.05))
            return -1;
    }
    m->asked = -1;
    json answer = {m->answer, m->answer + m->answer_length};
    if (is_true(member(answer, "ok")))
        return 0;
    read_error(answer, &m->error);
    return -1;
}

static json answer_key(const ecaxis *m, const char *key) {
    return member((json){m->answer, m->answer + m->answer_length}, key);
}

/* Appends `,"key":value`. Numbers have a point in every locale. */
static bool add_number(ecaxis *m, char keys[MAX_LINE], const char *key, double value) {
    size_t length = strlen(keys);
    locale_t before = uselocale(c_locale());
    snprintf(keys + length, MAX_LINE - length, ",\"%s\":%.17g", key, value);
    uselocale(before);
    if (!isfinite(value))
        set_error(&m->error, "bad_request", NULL, "", "`%s` is not a finite number", key);
    return isfinite(value);
}

static bool add_name(ecaxis *m, char keys[MAX_LINE], const char *key, const char *name) {
    size_t length = strlen(keys);
    if (length < MAX_NAMES) {
        length += (size_t)snprintf(keys + length, MAX_LINE - length, "%s\"%s\":", length ? "," : "", key);
        if (length < MAX_NAMES && quote(keys + length, MAX_NAMES - length, name))
            return true;
    }
    set_error(&m->error, "bad_request", NULL, "", "a name is too long");
    return false;
}

/* Attach and close. */

static int read_machine(ecaxis *m) {
    if (ask(m, "machine", "", ANSWER_S))
        return -1;
    json axes = answer_key(m, "axes"), axis, rest = axes;
    while (next_element(&rest, &axis))
        m->axes++;
    m->infos = calloc((size_t)m->axes + 1, sizeof *m->infos);
    if (!m->infos)
        return lose(m, "system", "out of memory");
    for (ecaxis_axis_info *info = m->infos; next_element(&axes, &axis); info++) {
        json limits = member(axis, "limits"), range = member(limits, "position"), end;
        to_text(member(axis, "name"), info->name, sizeof info->name);
        to_text(member(axis, "unit"), info->unit, sizeof info->unit);
        info->lowest = next_element(&range, &end) ? to_number(end) : -INFINITY;
        info->highest = next_element(&range, &end) ? to_number(end) : INFINITY;
        info->velocity = to_number(member(limits, "velocity"));
        info->acceleration = to_number(member(limits, "acceleration"));
        info->following_error = to_number(member(limits, "following_error"));
        info->homing = is_true(member(axis, "homing"));
    }
    return 0;
}

static int attach(ecaxis *m, const char *path, const ecaxis_options *options) {
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    const char *name = options->name ? options->name : "C";
    double timeout_s = options->timeout_s > 0 && options->timeout_s < 86400 ? options->timeout_s : 60;
    char keys[MAX_LINE] = "";
    begin_step(m, "attach", NULL);
    m->lease_s = options->lease_s > 0 ? options->lease_s : 2;
    if (strlen(path) >= sizeof address.sun_path) {
        set_error(&m->error, "system", NULL, "use a shorter path", "the path of the socket is too long: %s", path);
        return -1;
    }
    memcpy(address.sun_path, path, strlen(path));
    m->socket = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (m->socket < 0 || connect(m->socket, (struct sockaddr *)&address, sizeof address)) {
        set_error(&m->error, "lost", NULL, "start `ecaxis serve` with this socket", "cannot connect to %s: %s", path, strerror(errno));
        return -1;
    }
    if (!add_name(m, keys, "name", name) || ask(m, "hello", keys, ANSWER_S))
        return -1;
    if (to_number(answer_key(m, "protocol")) != 1)
        return lose(m, "protocol", "the server speaks another version of the protocol");
    m->virtual_time = is_true(answer_key(m, "virtual"));
    snprintf(keys, sizeof keys, "\"bus\":\"op\",\"timeout_ms\":%.0f", timeout_s * 1e3);
    if (ask(m, "await", keys, timeout_s + 1) || read_machine(m))
        return -1;
    return options->read_only ? 0 : ecaxis_take(m, options->force);
}

ecaxis *ecaxis_attach(const char *path, const ecaxis_options *options, ecaxis_error *error) {
    static const ecaxis_options defaults;
    ecaxis *m = calloc(1, sizeof *m);
    if (!m)
        return NULL;
    m->socket = m->descriptors[0] = m->descriptors[1] = -1;
    m->asked = -1;
    if (!attach(m, path, options ? options : &defaults))
        return m;
    if (error)
        *error = m->error;
    ecaxis_close(m);
    return NULL;
}

void ecaxis_close(ecaxis *m) {
    if (!m)
        return;
    for (int n = 0; n < 2; n++)
        if (m->descriptors[n] >= 0)
            close(m->descriptors[n]);
    if (m->socket >= 0)
        close(m->socket);
    free(m->infos);
    free(m->answer);
    free(m->input);
    free(m);
}

const ecaxis_error *ecaxis_last_error(const ecaxis *m) {
    return &m->error;
}

void ecaxis_print_error(FILE *file, const ecaxis_error *error) {
    fprintf(file, "%s%s%s: %s (%s)\n", error->device, error->device[0] ? ": " : "", error->step, error->cause, error->code);
    if (error->help[0])
        fprintf(file, "help: %s\n", error->help);
}

int ecaxis_axis_count(const ecaxis *m) {
    return m->axes;
}

int ecaxis_axis_number(ecaxis *m, const char *axis) {
    for (int n = 0; n < m->axes; n++)
        if (!strcmp(m->infos[n].name, axis))
            return n;
    begin_step(m, "find", axis);
    set_error(&m->error, "unknown_name", NULL, "see the machine file", "the machine has no such axis");
    return -1;
}

const ecaxis_axis_info *ecaxis_describe_axis(const ecaxis *m, int number) {
    return number >= 0 && number < m->axes ? &m->infos[number] : NULL;
}

/* State. */

int ecaxis_read_axis(ecaxis *m, const char *name, ecaxis_axis *state) {
    char text[ECAXIS_NAME];
    begin_step(m, "read", name);
    if (ask(m, "state", "", ANSWER_S))
        return -1;
    json axes = answer_key(m, "axes"), axis;
    while (next_element(&axes, &axis)) {
        to_text(member(axis, "name"), text, sizeof text);
        if (strcmp(text, name))
            continue;
        to_text(member(axis, "state"), state->state, sizeof state->state);
        state->enabled = is_true(member(axis, "enabled"));
        state->ready = is_true(member(axis, "ready"));
        state->moving = is_true(member(axis, "moving"));
        state->at_rest = is_true(member(axis, "at_rest"));
        state->homed = is_true(member(axis, "homed"));
        state->position = to_number(member(axis, "position"));
        state->velocity = to_number(member(axis, "velocity"));
        state->torque = to_number(member(axis, "torque"));
        state->target_position = to_number(member(axis, "target_position"));
        state->target_velocity = to_number(member(axis, "target_velocity"));
        state->following_error = to_number(member(axis, "following_error"));
        to_text(member(axis, "fault"), state->fault, sizeof state->fault);
        if (!state->fault[0])
            to_text(member(axis, "trip"), state->fault, sizeof state->fault);
        return 0;
    }
    set_error(&m->error, "unknown_name", NULL, "see the machine file", "the machine has no such axis");
    return -1;
}

int ecaxis_read_input(ecaxis *m, const char *device, const char *name, double *value) {
    char text[ECAXIS_NAME], text2[ECAXIS_NAME * 4];
    begin_step(m, "read", device);
    if (ask(m, "state", "", ANSWER_S))
        return -1;
    json inputs = answer_key(m, "inputs"), input;
    while (next_element(&inputs, &input)) {
        to_text(member(input, "device"), text, sizeof text);
        to_text(member(input, "name"), text2, sizeof text2);
        if (!strcmp(text, device) && !strcmp(text2, name)) {
            *value = to_number(member(input, "value"));
            return 0;
        }
    }
    set_error(&m->error, "unknown_name", NULL, "`ecaxis explain` lists the inputs", "the device has no input `%s`", name);
    return -1;
}

/* Commands. */

/* Sends a command with the inside of its object. One that is not `valid` has failed already. */
static int64_t command(ecaxis *m, const char *op, const char *keys, bool valid) {
    request *place = NULL;
    /* A free place, or that of the oldest outcome. */
    for (request *r = m->requests; r < m->requests + REQUESTS; r++)
        if ((!r->id || r->done) && (!place || r->id < place->id))
            place = r;
    if (!place) {
        set_error(&m->error, "busy", NULL, "wait for the outcome of earlier requests", "%d requests have no outcome yet", REQUESTS);
        return -1;
    }
    *place = (request){.id = ++m->ids};
    place->done = !valid || !send_request(m, place->id, op, true, keys);
    place->error = m->error;
    return place->id;
}

static int64_t axis_command(ecaxis *m, const char *op, const char *axis, const char *key, double value) {
    char keys[MAX_LINE] = "";
    begin_step(m, op, axis);
    bool valid = add_name(m, keys, "axis", axis) && (!key || add_number(m, keys, key, value));
    return command(m, op, keys, valid);
}

static int64_t move(ecaxis *m, const char *axis, const char *key, double value, double speed) {
    char keys[MAX_LINE] = "";
    begin_step(m, "move", axis);
    bool valid = add_name(m, keys, "axis", axis) && add_number(m, keys, key, value) && add_number(m, keys, "speed", speed);
    return command(m, "move", keys, valid);
}

int64_t ecaxis_enable(ecaxis *m, const char *axis) {
    return axis_command(m, "enable", axis, NULL, 0);
}

int64_t ecaxis_disable(ecaxis *m, const char *axis) {
    return axis_command(m, "disable", axis, NULL, 0);
}

int64_t ecaxis_reset(ecaxis *m, const char *axis) {
    return axis_command(m, "reset", axis, NULL, 0);
}

int64_t ecaxis_home(ecaxis *m, const char *axis) {
    return axis_command(m, "home", axis, NULL, 0);
}

int64_t ecaxis_move(ecaxis *m, const char *axis, double to, double speed) {
    return move(m, axis, "to", to, speed);
}

int64_t ecaxis_move_by(ecaxis *m, const char *axis, double by, double speed) {
    return move(m, axis, "by", by, speed);
}

int64_t ecaxis_velocity(ecaxis *m, const char *axis, double velocity) {
    return axis_command(m, "velocity", axis, "velocity", velocity);
}

int64_t ecaxis_halt(ecaxis *m, const char *axis) {
    return axis_command(m, "halt", axis, NULL, 0);
}

int64_t ecaxis_set_output(ecaxis *m, const char *device, const char *name, double value) {
    char keys[MAX_LINE] = "";
    begin_step(m, "output", device);
    bool valid = add_name(m, keys, "device", device) && add_name(m, keys, "output", name) && add_number(m, keys, "value", value);
    return command(m, "output", keys, valid);
}

int ecaxis_stop(ecaxis *m) {
    begin_step(m, "stop", NULL);
    return ask(m, "stop", "", ANSWER_S);
}

int ecaxis_emergency_stop(ecaxis *m) {
    begin_step(m, "emergency_stop", NULL);
    return ask(m, "emergency_stop", "", ANSWER_S);
}

int ecaxis_poll(ecaxis *m, int64_t id) {
    if (id < 0)
        return -1;
    receive(m, 0);
    for (request *r = m->requests; r < m->requests + REQUESTS; r++) {
        if (!id || r->id != id)
            continue;
        if (!r->done && m->lost)
            return -1;
        if (r->done && !r->ok && !m->lost)
            m->error = r->error;
        return r->done ? (r->ok ? 1 : -1) : 0;
    }
    begin_step(m, "wait", NULL);
    set_error(&m->error, "bad_request", NULL, "", "no request has the number %lld, or its outcome is too old", (long long)id);
    return -1;
}

int ecaxis_wait(ecaxis *m, int64_t id, double timeout_s) {
    double end = now_s() + timeout_s;
    int outcome;
    while ((outcome = ecaxis_poll(m, id)) == 0) {
        double rest = end - now_s();
        if (!(rest > 0)) {
            for (request *r = m->requests; r < m->requests + REQUESTS; r++)
                if (r->id == id)
                    m->error = r->error;
            set_error(&m->error, "timeout", NULL, "", "no outcome within %g s", timeout_s);
            return -1;
        }
        renew(m);
        receive(m, rest < m->lease_s / 10 ? rest : m->lease_s / 10);
    }
    return outcome == 1 ? 0 : -1;
}

/* The lease. */

int ecaxis_take(ecaxis *m, bool force) {
    char keys[64];
    begin_step(m, "take", NULL);
    snprintf(keys, sizeof keys, "\"ttl_ms\":%.0f%s", m->lease_s * 1e3, force ? ",\"force\":true" : "");
    memset(&m->lease_error, 0, sizeof m->lease_error);
    m->renewed = now_s();
    m->owns = ask(m, "take", keys, ANSWER_S) == 0;
    return m->owns ? 0 : -1;
}

int ecaxis_release(ecaxis *m) {
    begin_step(m, "release", NULL);
    m->owns = false;
    return ask(m, "release", "", ANSWER_S);
}

int ecaxis_keep(ecaxis *m) {
    renew(m);
    receive(m, 0);
    if (m->lease_error.code[0] && !m->lost)
        m->error = m->lease_error;
    return m->lost || m->lease_error.code[0] ? -1 : 0;
}

int ecaxis_sleep(ecaxis *m, double seconds) {
    char keys[MAX_LINE] = "";
    begin_step(m, "sleep", NULL);
    if (m->virtual_time) {
        return add_number(m, keys, "seconds", seconds) ? ask(m, "advance", keys + 1, 60 + seconds) : -1;
    }
    for (double end = now_s() + seconds, rest; (rest = end - now_s()) > 0;)
        if (ecaxis_keep(m) || receive(m, rest < m->lease_s / 10 ? rest : m->lease_s / 10))
            return -1;
    return m->lost ? -1 : 0;
}

int ecaxis_request(ecaxis *m, const char *op, const char *keys, char *answer, size_t size) {
    begin_step(m, op, NULL);
    if (strlen(op) >= ECAXIS_NAME || strpbrk(op, "\"\\\n")) {
        set_error(&m->error, "unknown_op", NULL, "docs/server.md lists the operations", "`%s` is not an operation", op);
        return -1;
    }
    int result = ask(m, op, keys ? keys : "", 60);
    if (size)
        snprintf(answer, size, "%s", m->answer ? m->answer : "");
    return result;
}

/* The cyclic area: words of 64 bits, see docs/server.md. */

enum { ROWS_AT = 2, ROW_WORDS, ROWS, CYCLE_NS, WRITTEN, NEXT_NS, TEXT_AT, TEXT_BYTES };
enum { AXES_AT = 2, AXIS_WORDS, AXES, SEQUENCE, COUNTER, FROM_ROW, LAST_USED, USED, LATE, REFUSED, STOPPED, HEADER = 16 };
enum { FLAGS = 3, IN_OP = 2, STOPPING = 4 };

typedef struct area {
    word *words;
    size_t bytes;
} area;

struct ecaxis_cyclic {
    area samples, commands;
    size_t rows_at, row_words, rows, axes_at, axis_words, axes;
    uint64_t cycle_ns, next, counter; /* the number of the next row */
    uint64_t *row;
    uint64_t *prepared; /* kind and value of each axis */
    char *text;
    json signals;
};

static uint64_t load(const area *from, size_t at) {
    return atomic_load_explicit(from->words + at, memory_order_relaxed);
}

static void store(area *to, size_t at, uint64_t value) {
    atomic_store_explicit(to->words + at, value, memory_order_relaxed);
}

/* Maps memory that cannot shrink: an access would end the program. */
static bool map(area *to, int fd, int protection, const char *magic) {
    struct stat file;
    int seals = fcntl(fd, F_GET_SEALS);
    if (seals < 0 || !(seals & F_SEAL_SHRINK) || fstat(fd, &file) || file.st_size < HEADER * 8 || file.st_size > (off_t)4 << 30)
        return false;
    void *base = mmap(NULL, (size_t)file.st_size, protection, MAP_SHARED | MAP_POPULATE, fd, 0);
    if (base == MAP_FAILED)
        return false;
    to->words = base;
    to->bytes = (size_t)file.st_size;
    return !memcmp(base, magic, 8) && load(to, 1) == 1;
}

/* The layout is read once, and every part of it lies in the memory. */
static bool check_layout(ecaxis_cyclic *c, int axes) {
    size_t words = c->samples.bytes / 8;
    c->rows_at = load(&c->samples, ROWS_AT);
    c->row_words = load(&c->samples, ROW_WORDS);
    c->rows = load(&c->samples, ROWS);
    c->cycle_ns = load(&c->samples, CYCLE_NS);
    size_t at = load(&c->samples, TEXT_AT), length = load(&c->samples, TEXT_BYTES), bytes = c->samples.bytes;
    if (c->rows_at > words || c->row_words > words || c->rows > words || c->row_words <= FLAGS || !c->rows || !c->cycle_ns ||
        c->rows_at + c->rows * c->row_words > words || at > bytes || length > bytes - at)
        return false;
    c->axes_at = load(&c->commands, AXES_AT);
    c->axis_words = load(&c->commands, AXIS_WORDS);
    c->axes = load(&c->commands, AXES);
    words = c->commands.bytes / 8;
    if (c->axes != (size_t)axes || c->axes_at < HEADER || c->axes_at > words || c->axis_words > words || c->axis_words < 2 ||
        c->axes_at + c->axes * c->axis_words > words)
        return false;
    c->text = malloc(length + 1);
    c->row = calloc(c->row_words, sizeof *c->row);
    c->prepared = calloc(c->axes + 1, 2 * sizeof *c->prepared);
    if (!c->text || !c->row || !c->prepared)
        return false;
    memcpy(c->text, (const char *)c->samples.words + at, length);
    json text = {c->text, skip_value(c->text, c->text + length, 0)};
    if (!text.end)
        return false;
    c->signals = member(text, "signals");
    return true;
}

ecaxis_cyclic *ecaxis_cyclic_open(ecaxis *m) {
    ecaxis_cyclic *c = calloc(1, sizeof *c);
    begin_step(m, "area", NULL);
    if (!c || ask(m, "area", "", ANSWER_S)) {
        free(c);
        return NULL;
    }
    bool good = map(&c->samples, m->descriptors[0], PROT_READ, "ECAXSMPL") &&
                map(&c->commands, m->descriptors[1], PROT_READ | PROT_WRITE, "ECAXCMDS") && check_layout(c, m->axes);
    for (int n = 0; n < 2; n++) {
        if (m->descriptors[n] >= 0)
            close(m->descriptors[n]);
        m->descriptors[n] = -1;
    }
    if (good) {
        c->counter = load(&c->commands, COUNTER);
        c->next = load(&c->samples, WRITTEN) - 1;
        ecaxis_cyclic_poll(c);
        return c;
    }
    set_error(&m->error, "protocol", NULL, "", "the shared memory of the server has another layout");
    ecaxis_cyclic_close(c);
    return NULL;
}

void ecaxis_cyclic_close(ecaxis_cyclic *c) {
    if (!c)
        return;
    if (c->signals.at) {
        memset(c->prepared, 0, c->axes * 2 * sizeof *c->prepared);
        ecaxis_cyclic_publish(c);
    }
    if (c->samples.words)
        munmap(c->samples.words, c->samples.bytes);
    if (c->commands.words)
        munmap(c->commands.words, c->commands.bytes);
    free(c->text);
    free(c->row);
    free(c->prepared);
    free(c);
}

double ecaxis_cyclic_time(const ecaxis_cyclic *c) {
    return (double)c->cycle_ns * 1e-9;
}

int ecaxis_cyclic_poll(ecaxis_cyclic *c) {
    for (int attempt = 0; attempt < 3; attempt++) {
        uint64_t written = atomic_load_explicit(c->samples.words + WRITTEN, memory_order_acquire), passed = written - c->next;
        if (!written || !passed)
            return 0;
        size_t at = c->rows_at + (written - 1) % c->rows * c->row_words;
        uint64_t before = atomic_load_explicit(c->samples.words + at, memory_order_acquire);
        for (size_t n = 0; n < c->row_words; n++)
            c->row[n] = load(&c->samples, at + n);
        atomic_thread_fence(memory_order_acquire);
        if (before != written || load(&c->samples, at) != written)
            continue;
        c->next = written;
        return passed > INT32_MAX ? INT32_MAX : (int)passed;
    }
    return 0;
}

int ecaxis_cyclic_wait(ecaxis_cyclic *c) {
    double begin = now_s();
    int passed;
    while ((passed = ecaxis_cyclic_poll(c)) == 0) {
        struct timespec pause = {0, 20000}, due;
        double now = now_s(), rest = (double)ecaxis_cyclic_next_ns(c) * 1e-9 - now;
        if (now - begin > NO_CYCLE_NS * 1e-9)
            return -1;
        /* Until the cycle is due, then in short pauses until its row is there. */
        if (rest > 0 && rest < 2 * ecaxis_cyclic_time(c) && rest < 0.1)
            pause.tv_nsec = (long)(rest * 1e9);
        nanosleep(&pause, &due);
    }
    return passed;
}

int ecaxis_cyclic_signal(const ecaxis_cyclic *c, const char *name) {
    json signals = c->signals, signal;
    char text[ECAXIS_NAME * 5];
    while (next_element(&signals, &signal)) {
        to_text(member(signal, "name"), text, sizeof text);
        double word = to_number(member(signal, "word"));
        if (!strcmp(text, name) && word >= 0 && word < (double)c->row_words)
            return (int)word;
    }
    return -1;
}

double ecaxis_cyclic_value(const ecaxis_cyclic *c, int signal) {
    double value = NAN;
    if (signal > FLAGS && (size_t)signal < c->row_words && c->row[0])
        memcpy(&value, c->row + signal, sizeof value);
    return value;
}

uint64_t ecaxis_cyclic_next_ns(const ecaxis_cyclic *c) {
    return load(&c->samples, NEXT_NS);
}

bool ecaxis_cyclic_in_op(const ecaxis_cyclic *c) {
    return (c->row[FLAGS] & (IN_OP | STOPPING)) == IN_OP;
}

void ecaxis_cyclic_set(ecaxis_cyclic *c, int axis, ecaxis_kind kind, double value) {
    if (axis < 0 || (size_t)axis >= c->axes)
        return;
    c->prepared[2 * axis] = (uint64_t)kind;
    memcpy(&c->prepared[2 * axis + 1], &value, sizeof value);
}

uint64_t ecaxis_cyclic_publish(ecaxis_cyclic *c) {
    uint64_t sequence = load(&c->commands, SEQUENCE) & ~(uint64_t)1;
    store(&c->commands, SEQUENCE, sequence + 1);
    atomic_thread_fence(memory_order_release);
    store(&c->commands, COUNTER, ++c->counter);
    store(&c->commands, FROM_ROW, c->next);
    for (size_t n = 0; n < 2 * c->axes; n++)
        store(&c->commands, c->axes_at + n / 2 * c->axis_words + n % 2, c->prepared[n]);
    atomic_store_explicit(c->commands.words + SEQUENCE, sequence + 2, memory_order_release);
    return c->counter;
}

bool ecaxis_cyclic_stopped(const ecaxis_cyclic *c, int axis) {
    return axis >= 0 && load(&c->commands, STOPPED) >> (axis < 63 ? axis : 63) & 1;
}

ecaxis_counters ecaxis_cyclic_counters(const ecaxis_cyclic *c) {
    return (ecaxis_counters){load(&c->commands, USED), load(&c->commands, LATE), load(&c->commands, REFUSED),
                             load(&c->commands, LAST_USED)};
}
