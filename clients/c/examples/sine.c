/* A set-point for the first axis in every cycle: a sine of 1 Hz around the place where it stands.
 *
 *   ecaxis serve configs/demo.toml --sim --socket demo.sock &
 *   chrt -f 40 ./sine demo.sock [SECONDS] */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "ecaxis.h"

static const double pi = 3.14159265358979;

int main(int count, char **arguments) {
    double seconds = count > 2 ? atof(arguments[2]) : 60, amplitude = 2;
    ecaxis_error error;
    if (count < 2)
        return fprintf(stderr, "usage: %s SOCKET [SECONDS]\n", arguments[0]), 2;
    ecaxis *machine = ecaxis_attach(arguments[1], &(ecaxis_options){.name = "sine", .lease_s = 0.5}, &error);
    if (!machine)
        return ecaxis_print_error(stderr, &error), 1;
    const char *name = ecaxis_describe_axis(machine, 0)->name;
    char signal[ECAXIS_NAME + 20];
    snprintf(signal, sizeof signal, "%s.target_position", name);
    ecaxis_cyclic *cyclic = NULL;
    if (ecaxis_wait(machine, ecaxis_enable(machine, name), 10) || !(cyclic = ecaxis_cyclic_open(machine))) {
        ecaxis_print_error(stderr, ecaxis_last_error(machine));
        ecaxis_close(machine);
        return 1;
    }
    double start = ecaxis_cyclic_value(cyclic, ecaxis_cyclic_signal(cyclic, signal));
    double time = 0;
    int failed = 0;
    printf("running\n");
    fflush(stdout);
    while (time < seconds && !failed) {
        double phase = 2 * pi * time;
        ecaxis_cyclic_set(cyclic, 0, ECAXIS_POSITION, start + amplitude * (1 - cos(phase)));
        ecaxis_cyclic_publish(cyclic);
        int passed = ecaxis_cyclic_wait(cyclic);
        time += passed * ecaxis_cyclic_time(cyclic);
        if (passed < 0)
            failed = fprintf(stderr, "no cycle for a second: the server has ended, or the bus is down\n");
        else if (ecaxis_cyclic_stopped(cyclic, 0))
            failed = fprintf(stderr, "the axis has stopped: a set-point was refused, or came too late\n");
        else if (ecaxis_keep(machine))
            ecaxis_print_error(stderr, ecaxis_last_error(machine)), failed = 1;
    }
    ecaxis_counters counters = ecaxis_cyclic_counters(cyclic);
    printf("used %llu late %llu refused %llu\n", (unsigned long long)counters.used, (unsigned long long)counters.late,
           (unsigned long long)counters.refused);
    ecaxis_cyclic_close(cyclic);
    ecaxis_close(machine);
    return failed != 0;
}
