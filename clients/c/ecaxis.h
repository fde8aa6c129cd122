/* ecaxis for C: commands a machine that `ecaxis serve` runs.
 *
 * Functions return 0 or a number of a request; -1 says that they failed, and `ecaxis_last_error`
 * says why. Positions are in the unit of the axis, velocities in units per second, torques in
 * percent of the rated torque, times in seconds.
 *
 * One thread at a time uses a machine. Another one may use its `ecaxis_cyclic`. */
#ifndef ECAXIS_H
#define ECAXIS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

#ifdef __cplusplus
extern "C" {
#endif

#define ECAXIS_NAME 64

/* What failed. Texts that do not apply are empty. */
typedef struct ecaxis_error {
    char code[24];            /* as in docs/server.md; also "lost", "protocol", "system" */
    char device[ECAXIS_NAME]; /* the axis or device */
    char step[ECAXIS_NAME];   /* the operation, such as "move" */
    char cause[512];
    char help[256]; /* what to do */
} ecaxis_error;

/* A connection to a machine. */
typedef struct ecaxis ecaxis;

/* Zero or NULL means the default. */
typedef struct ecaxis_options {
    const char *name;  /* the name of this client; "C" */
    double lease_s;    /* the longest silence of this client, after which its axes stop; 2 */
    double timeout_s;  /* the time until the bus is in Op; 60 */
    bool read_only;    /* does not take the lease: commands are refused */
    bool force;        /* takes the lease from another client, whose axes stop first */
} ecaxis_options;

/* An axis as the machine file describes it. Limits that do not exist are infinite or NAN. */
typedef struct ecaxis_axis_info {
    char name[ECAXIS_NAME];
    char unit[16];
    double lowest, highest;
    double velocity, acceleration;
    double following_error;
    bool homing; /* `ecaxis_home` is possible */
} ecaxis_axis_info;

/* The state of an axis. Numbers are NAN while the bus is not in Op. */
typedef struct ecaxis_axis {
    char state[48]; /* of CiA 402, such as "Operation enabled" */
    bool enabled;
    bool ready; /* it obeys motion commands */
    bool moving, at_rest, homed;
    double position, velocity, torque;
    double target_position, target_velocity;
    double following_error;
    char fault[256]; /* the fault of the drive or the trip of the supervision; empty without one */
} ecaxis_axis;

/* Connects to the socket of a server, waits until the bus is in Op and takes the lease. Returns
 * NULL and fills `error` (which may be NULL) if that fails. */
ecaxis *ecaxis_attach(const char *socket, const ecaxis_options *options, ecaxis_error *error);

/* Ends the connection: what this client moved stops within its limits. NULL is permitted. */
void ecaxis_close(ecaxis *machine);

/* Returns the last error. It stays valid until the next call. */
const ecaxis_error *ecaxis_last_error(const ecaxis *machine);

/* Writes an error as text: "x: move: 1000 is outside the range [-60, 60] (refused)". */
void ecaxis_print_error(FILE *file, const ecaxis_error *error);

/* Returns the number of axes. */
int ecaxis_axis_count(const ecaxis *machine);
/* Returns the number of an axis from its name, or -1. */
int ecaxis_axis_number(ecaxis *machine, const char *axis);
/* Returns the description of an axis, or NULL. */
const ecaxis_axis_info *ecaxis_describe_axis(const ecaxis *machine, int number);

/* Read the present state. */
int ecaxis_read_axis(ecaxis *machine, const char *axis, ecaxis_axis *state);
int ecaxis_read_input(ecaxis *machine, const char *device, const char *name, double *value);

/* Commands. They return the number of the request at once; `ecaxis_wait` returns its outcome, also
 * that of a request which was never sent. -1: too many requests have no outcome yet.
 * `axis` may be "*" in the first three: all axes. */
int64_t ecaxis_enable(ecaxis *machine, const char *axis);
int64_t ecaxis_disable(ecaxis *machine, const char *axis); /* decelerates, then removes power */
int64_t ecaxis_reset(ecaxis *machine, const char *axis);   /* resets faults and trips */
int64_t ecaxis_home(ecaxis *machine, const char *axis);
/* `speed`: a fraction of the velocity limit, above 0 and at most 1. */
int64_t ecaxis_move(ecaxis *machine, const char *axis, double to, double speed);
int64_t ecaxis_move_by(ecaxis *machine, const char *axis, double by, double speed);
/* Runs until the next command. */
int64_t ecaxis_velocity(ecaxis *machine, const char *axis, double velocity);
int64_t ecaxis_halt(ecaxis *machine, const char *axis); /* decelerates and holds */
int64_t ecaxis_set_output(ecaxis *machine, const char *device, const char *name, double value);
/* All axes decelerate and hold. Needs no lease. */
int ecaxis_stop(ecaxis *machine);
/* Each axis stops as the machine file says and loses power. Needs no lease. */
int ecaxis_emergency_stop(ecaxis *machine);

/* Waits for the outcome of a request and keeps the lease meanwhile. Returns -1 if the request is -1,
 * was refused, did not reach its end, or if there is no outcome in time ("timeout"). */
int ecaxis_wait(ecaxis *machine, int64_t request, double timeout_s);
/* Returns 1 once the request has reached its end, 0 before, and -1 if it failed. Does not wait. */
int ecaxis_poll(ecaxis *machine, int64_t request);

/* Waits and keeps the lease. With `ecaxis serve --virtual`, time advances. */
int ecaxis_sleep(ecaxis *machine, double seconds);
/* Keeps the lease: renews it if a third of its time is over. Never blocks. */
int ecaxis_keep(ecaxis *machine);
int ecaxis_take(ecaxis *machine, bool force);
/* Gives the lease back. What this client moved stops. */
int ecaxis_release(ecaxis *machine);

/* Any operation of docs/server.md. `keys` is the inside of a JSON object, such as
 * "\"device\": \"x\", \"index\": 24641", or NULL. Copies the answer, cut to `size` bytes. */
int ecaxis_request(ecaxis *machine, const char *op, const char *keys, char *answer, size_t size);

/* Set-points in every cycle, in shared memory. None of these functions uses the connection. */
typedef struct ecaxis_cyclic ecaxis_cyclic;

typedef enum ecaxis_kind {
    ECAXIS_NONE = 0, /* the axis decelerates and holds */
    ECAXIS_POSITION = 1,
    ECAXIS_VELOCITY = 2,
    ECAXIS_TORQUE = 3
} ecaxis_kind;

typedef struct ecaxis_counters {
    uint64_t used;    /* sets that the server has used */
    uint64_t late;    /* cycles without a new set */
    uint64_t refused; /* set-points that it has refused */
    uint64_t last;    /* the number of the last set that it has used */
} ecaxis_counters;

/* Maps the memory. NULL if that fails; the machine has the error. Needs the lease. */
ecaxis_cyclic *ecaxis_cyclic_open(ecaxis *machine);
/* Its axes decelerate and hold. NULL is permitted. */
void ecaxis_cyclic_close(ecaxis_cyclic *cyclic);

/* Returns the cycle time. */
double ecaxis_cyclic_time(const ecaxis_cyclic *cyclic);
/* Sleeps until the next cycle. Returns how many have passed since the last call: more than 1 if some
 * were missed; -1 if none came for a second: the server has ended, or the bus is down. */
int ecaxis_cyclic_wait(ecaxis_cyclic *cyclic);
/* The same without waiting: 0 if there is no new cycle. For a program with a clock of its own. */
int ecaxis_cyclic_poll(ecaxis_cyclic *cyclic);
/* Returns the number of a signal such as "x.position" or "io.Input 1", or -1. The signals of an axis
 * are position, velocity, torque, target_position, target_velocity, target_torque,
 * following_error, statusword, controlword, mode, encoder_difference. */
int ecaxis_cyclic_signal(const ecaxis_cyclic *cyclic, const char *name);
/* Returns the value of a signal in the last cycle; NAN: none. */
double ecaxis_cyclic_value(const ecaxis_cyclic *cyclic, int signal);
/* Returns the due time of the next cycle, in ns of CLOCK_MONOTONIC. */
uint64_t ecaxis_cyclic_next_ns(const ecaxis_cyclic *cyclic);
/* Returns true if the bus was in Op in the last cycle, and no stop was under way. */
bool ecaxis_cyclic_in_op(const ecaxis_cyclic *cyclic);
/* Prepares the set-point of an axis by its number. The first position must be where the axis is. */
void ecaxis_cyclic_set(ecaxis_cyclic *cyclic, int axis, ecaxis_kind kind, double value);
/* Makes the prepared set-points valid for the next cycle. Returns the number of the set. An axis that
 * starts fast keeps its first position until the server has used that set. */
uint64_t ecaxis_cyclic_publish(ecaxis_cyclic *cyclic);
/* Returns true if the server has refused a set-point of the axis, or none came in time: the axis has
 * stopped, and follows again after a set with ECAXIS_NONE. */
bool ecaxis_cyclic_stopped(const ecaxis_cyclic *cyclic, int axis);
ecaxis_counters ecaxis_cyclic_counters(const ecaxis_cyclic *cyclic);

#ifdef __cplusplus
}
#endif
#endif
