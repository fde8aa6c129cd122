/* A HAL component of LinuxCNC: axes of `ecaxis serve` as joints, see README.md.
 *
 * The functions `read` and `write` use shared memory only. A thread of its own holds the connection:
 * it attaches, keeps the lease, and enables, disables and resets. */
#include <errno.h>
#include <math.h>
#include <pthread.h>
#include <stdatomic.h>
#include <string.h>
#include <time.h>

#include "ecaxis.h"
#include "hal.h"
#include "rtapi.h"
#include "rtapi_app.h"

MODULE_DESCRIPTION("Axes of ecaxis serve");
MODULE_LICENSE("Dual MIT/Apache-2.0");

#define MAX_JOINTS 16
/* Without a cycle for this time, the bus is down. */
#define SILENCE_NS 100000000
/* Without a call of `write` for this time, the thread of HAL has stopped. */
#define NO_CALL_S 0.5
#define RETRY_S 1.0
#define PERIOD_S 0.01
/* The part of the phase error that one period of the thread corrects, and the most of a period. */
#define PHASE_GAIN 50
#define PHASE_LIMIT 200

static char *socket = "";
RTAPI_MP_STRING(socket, "the socket of ecaxis serve");
static char *axes[MAX_JOINTS];
RTAPI_MP_ARRAY_STRING(axes, MAX_JOINTS, "the names of the axes");
static char *home[MAX_JOINTS];
RTAPI_MP_ARRAY_STRING(home, MAX_JOINTS, "the inputs that are home switches, such as io.Input 1");

typedef struct pins {
    hal_float_t *pos_cmd, *pos_fb, *vel_fb, *torque_fb, *ferror;
    hal_bit_t *enable, *reset, *enabled, *fault, *home_switch;
} pins;

typedef struct shared_pins {
    hal_bit_t *connected;
    hal_u32_t *late, *refused;
} shared_pins;

typedef struct joint {
    pins *pins;
    int number; /* in the area */
    int position, velocity, torque, error, statusword, home_switch;
    /* Of the functions. */
    bool follows, stopped, reset_before;
    double begin;   /* the first command that it follows */
    uint64_t first; /* the number of its set; 0 before it is published */
    /* From the functions to the thread, and back. */
    atomic_bool wanted, reset, powered, failed;
    /* Of the thread. */
    bool is_on;
    int64_t request;
} joint;

static int component;
static int joints;
static joint joint_of[MAX_JOINTS];
static shared_pins *all;
static atomic_uint calls;
static atomic_bool ending;
static pthread_t thread;
/* The functions only try it: they skip a period while the thread replaces the area. */
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static ecaxis_cyclic *area;
static long silence_ns;

/* The functions of HAL. */

/* Shifts the thread until it begins half a cycle before the next one of ecaxis: each set-point is new
 * in its cycle. */
static void follow_phase(void) {
    long cycle = lround(ecaxis_cyclic_time(area) * 1e9);
    long long begin = rtapi_task_pll_get_reference(), wanted = (long long)ecaxis_cyclic_next_ns(area) - cycle / 2;
    if (!begin || !cycle)
        return;
    long error = (long)((begin - wanted) % cycle), most = cycle / PHASE_LIMIT;
    error += error < -cycle / 2 ? cycle : error > cycle / 2 ? -cycle : 0;
    long step = -error / PHASE_GAIN;
    rtapi_task_pll_set_correction(step > most ? most : step < -most ? -most : step);
}

/* Writes a value to a pin; without one, the pin keeps the last. */
static void update(hal_float_t *pin, int signal) {
    double value = ecaxis_cyclic_value(area, signal);
    if (!isnan(value))
        *pin = value;
}

static void read_all(void *nothing, long period) {
    (void)nothing;
    if (pthread_mutex_trylock(&lock))
        return;
    bool is_new = area && ecaxis_cyclic_poll(area) > 0;
    silence_ns = is_new ? 0 : silence_ns < SILENCE_NS ? silence_ns + period : silence_ns;
    if (is_new)
        follow_phase();
    *all->connected = area && silence_ns < SILENCE_NS && ecaxis_cyclic_in_op(area);
    if (area) {
        ecaxis_counters counters = ecaxis_cyclic_counters(area);
        *all->late = (hal_u32_t)counters.late;
        *all->refused = (hal_u32_t)counters.refused;
    }
    for (joint *j = joint_of; area && j < joint_of + joints; j++) {
        update(j->pins->pos_fb, j->position);
        update(j->pins->vel_fb, j->velocity);
        update(j->pins->torque_fb, j->torque);
        update(j->pins->ferror, j->error);
        double home_switch = ecaxis_cyclic_value(area, j->home_switch);
        *j->pins->home_switch = home_switch != 0 && !isnan(home_switch);
    }
    pthread_mutex_unlock(&lock);
}

/* Follows the command from Operation enabled on, until the server stops the axis or the connection is
 * lost: then only from the next edge of `enable`. No axis gets power without that edge. */
static void write_joint(joint *j) {
    unsigned statusword = 0;
    double value = area ? ecaxis_cyclic_value(area, j->statusword) : NAN;
    if (value >= 0 && value < 65536)
        statusword = (unsigned)value;
    bool enable = *j->pins->enable, is_up = *all->connected, has_fault = (statusword & 0x48) == 0x08;
    bool is_on = is_up && atomic_load(&j->powered) && (statusword & 0x6f) == 0x27;
    if (!enable)
        j->follows = j->stopped = false;
    else if (!is_up || (j->follows && (!is_on || ecaxis_cyclic_stopped(area, j->number))))
        j->stopped = true;
    bool begins = enable && is_on && !j->stopped && !j->follows;
    j->follows = enable && is_on && !j->stopped;
    if (begins) {
        j->begin = *j->pins->pos_cmd;
        j->first = 0;
    }
    /* The server begins with the set that it uses first, wherever the command is by then. */
    bool is_used = j->follows && j->first && ecaxis_cyclic_counters(area).last >= j->first;
    if (area)
        ecaxis_cyclic_set(area, j->number, j->follows ? ECAXIS_POSITION : ECAXIS_NONE, is_used ? *j->pins->pos_cmd : j->begin);
    if (*j->pins->reset && !j->reset_before)
        atomic_store(&j->reset, true);
    j->reset_before = *j->pins->reset;
    atomic_store(&j->wanted, enable && !j->stopped);
    *j->pins->enabled = is_used;
    *j->pins->fault = has_fault || j->stopped || (enable && atomic_load(&j->failed));
}

static void write_all(void *nothing, long period) {
    (void)nothing;
    (void)period;
    atomic_fetch_add(&calls, 1);
    if (pthread_mutex_trylock(&lock))
        return;
    for (joint *j = joint_of; j < joint_of + joints; j++)
        write_joint(j);
    uint64_t number = area ? ecaxis_cyclic_publish(area) : 0;
    for (joint *j = joint_of; j < joint_of + joints; j++)
        if (j->follows && !j->first)
            j->first = number;
    pthread_mutex_unlock(&lock);
}

/* The thread. */

static void print_error(const ecaxis_error *error) {
    rtapi_print_msg(RTAPI_MSG_ERR, "ecaxis: %s%s%s: %s (%s)%s%s\n", error->device, error->device[0] ? ": " : "",
                    error->step, error->cause, error->code, error->help[0] ? "; " : "", error->help);
}

static void pause_s(double seconds) {
    struct timespec time = {(time_t)seconds, (long)((seconds - floor(seconds)) * 1e9)};
    nanosleep(&time, NULL);
}

static int find_signal(const ecaxis_cyclic *cyclic, const char *axis, const char *name) {
    char text[ECAXIS_NAME + 32];
    snprintf(text, sizeof text, "%s.%s", axis, name);
    return ecaxis_cyclic_signal(cyclic, text);
}

/* Finds the axes and their signals. Returns false if one does not exist. */
static bool find_all(ecaxis *machine, const ecaxis_cyclic *cyclic) {
    for (int n = 0; n < joints; n++) {
        joint *j = &joint_of[n];
        j->number = ecaxis_axis_number(machine, axes[n]);
        if (j->number < 0) {
            print_error(ecaxis_last_error(machine));
            return false;
        }
        j->position = find_signal(cyclic, axes[n], "position");
        j->velocity = find_signal(cyclic, axes[n], "velocity");
        j->torque = find_signal(cyclic, axes[n], "torque");
        j->error = find_signal(cyclic, axes[n], "following_error");
        j->statusword = find_signal(cyclic, axes[n], "statusword");
        j->home_switch = home[n] && *home[n] ? ecaxis_cyclic_signal(cyclic, home[n]) : -1;
        if (home[n] && *home[n] && j->home_switch < 0) {
            rtapi_print_msg(RTAPI_MSG_ERR, "ecaxis: %s: the machine has no input `%s`\n", axes[n], home[n]);
            return false;
        }
    }
    return true;
}

static void replace_area(ecaxis_cyclic *with) {
    pthread_mutex_lock(&lock);
    ecaxis_cyclic *before = area;
    area = with;
    pthread_mutex_unlock(&lock);
    ecaxis_cyclic_close(before);
}

/* Enables, disables and resets as the pins ask. */
static void serve_joint(ecaxis *machine, joint *j, const char *axis) {
    if (j->request > 0) {
        int outcome = ecaxis_poll(machine, j->request);
        if (outcome == 0)
            return;
        if (outcome < 0) {
            print_error(ecaxis_last_error(machine));
            atomic_store(&j->failed, j->is_on);
        }
        j->request = 0;
        atomic_store(&j->powered, outcome > 0 && j->is_on);
    }
    bool wanted = atomic_load(&j->wanted);
    if (!wanted)
        atomic_store(&j->failed, false);
    if (wanted != j->is_on) {
        j->is_on = wanted;
        j->request = wanted ? ecaxis_enable(machine, axis) : ecaxis_disable(machine, axis);
    } else if (atomic_exchange(&j->reset, false)) {
        j->request = ecaxis_reset(machine, axis);
    }
}

/* Serves the pins until the connection or the lease is lost, or HAL no longer calls `write`. */
static void serve_all(ecaxis *machine) {
    unsigned before = atomic_load(&calls) - 1;
    double idle_s = 0;
    while (!atomic_load(&ending) && idle_s < NO_CALL_S) {
        unsigned now = atomic_load(&calls);
        idle_s = now == before ? idle_s + PERIOD_S : 0;
        before = now;
        for (int n = 0; n < joints; n++)
            serve_joint(machine, &joint_of[n], axes[n]);
        if (ecaxis_sleep(machine, PERIOD_S)) {
            print_error(ecaxis_last_error(machine));
            return;
        }
    }
}

static void *run(void *nothing) {
    ecaxis_options options = {.name = "LinuxCNC", .lease_s = 0.5, .timeout_s = 1};
    char last[sizeof(((ecaxis_error *)0)->cause)] = "";
    while (!atomic_load(&ending)) {
        ecaxis_error error = {.code = ""};
        ecaxis *machine = ecaxis_attach(socket, &options, &error);
        ecaxis_cyclic *cyclic = machine ? ecaxis_cyclic_open(machine) : NULL;
        if (machine && !cyclic)
            error = *ecaxis_last_error(machine);
        if (!cyclic && strcmp(last, error.cause))
            print_error(&error);
        snprintf(last, sizeof last, "%s", error.cause);
        if (cyclic && find_all(machine, cyclic)) {
            for (joint *j = joint_of; j < joint_of + joints; j++)
                j->is_on = false, j->request = 0, atomic_store(&j->powered, false);
            replace_area(cyclic);
            serve_all(machine);
            replace_area(NULL);
        } else {
            ecaxis_cyclic_close(cyclic);
        }
        ecaxis_close(machine);
        /* Another attempt comes once HAL calls `write` again. */
        unsigned before = atomic_load(&calls);
        for (double time = 0; !atomic_load(&ending) && (time < RETRY_S || atomic_load(&calls) == before); time += PERIOD_S)
            pause_s(PERIOD_S);
    }
    return nothing;
}

/* Loading. */

static int export_joint(int n) {
    pins *p = joint_of[n].pins = hal_malloc(sizeof *p);
    const char *name = axes[n];
    int failed = !p;
    if (failed)
        return -ENOMEM;
    failed |= hal_pin_float_newf(HAL_IN, &p->pos_cmd, component, "ecaxis.%s.pos-cmd", name);
    failed |= hal_pin_float_newf(HAL_OUT, &p->pos_fb, component, "ecaxis.%s.pos-fb", name);
    failed |= hal_pin_float_newf(HAL_OUT, &p->vel_fb, component, "ecaxis.%s.vel-fb", name);
    failed |= hal_pin_float_newf(HAL_OUT, &p->torque_fb, component, "ecaxis.%s.torque-fb", name);
    failed |= hal_pin_float_newf(HAL_OUT, &p->ferror, component, "ecaxis.%s.ferror", name);
    failed |= hal_pin_bit_newf(HAL_IN, &p->enable, component, "ecaxis.%s.enable", name);
    failed |= hal_pin_bit_newf(HAL_IN, &p->reset, component, "ecaxis.%s.reset", name);
    failed |= hal_pin_bit_newf(HAL_OUT, &p->enabled, component, "ecaxis.%s.enabled", name);
    failed |= hal_pin_bit_newf(HAL_OUT, &p->fault, component, "ecaxis.%s.fault", name);
    failed |= hal_pin_bit_newf(HAL_OUT, &p->home_switch, component, "ecaxis.%s.home-switch", name);
    return failed ? -EINVAL : 0;
}

static int export_all(void) {
    int failed = 0;
    all = hal_malloc(sizeof *all);
    if (!all)
        return -ENOMEM;
    failed |= hal_pin_bit_newf(HAL_OUT, &all->connected, component, "ecaxis.connected");
    failed |= hal_pin_u32_newf(HAL_OUT, &all->late, component, "ecaxis.late");
    failed |= hal_pin_u32_newf(HAL_OUT, &all->refused, component, "ecaxis.refused");
    for (joints = 0; joints < MAX_JOINTS && axes[joints] && *axes[joints] && !failed; joints++)
        failed |= export_joint(joints);
    if (!joints || !*socket) {
        rtapi_print_msg(RTAPI_MSG_ERR, "ecaxis: loadrt ecaxis socket=PATH axes=NAME,NAME\n");
        return -EINVAL;
    }
    failed |= hal_export_funct("ecaxis.read", read_all, NULL, 1, 0, component);
    failed |= hal_export_funct("ecaxis.write", write_all, NULL, 1, 0, component);
    return failed ? -EINVAL : 0;
}

int rtapi_app_main(void) {
    component = hal_init("ecaxis");
    if (component < 0)
        return component;
    int failed = export_all();
    if (!failed)
        failed = -pthread_create(&thread, NULL, run, NULL);
    if (failed) {
        hal_exit(component);
        return failed;
    }
    return hal_ready(component);
}

void rtapi_app_exit(void) {
    atomic_store(&ending, true);
    pthread_join(thread, NULL);
    hal_exit(component);
}
