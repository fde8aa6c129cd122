/* Calls every function of the client, whatever the server answers. The tests run it against hostile ones. */
#include <locale.h>
#include <math.h>

#include "ecaxis.h"

static void use_area(ecaxis *machine) {
    ecaxis_cyclic *cyclic = ecaxis_cyclic_open(machine);
    if (!cyclic) {
        ecaxis_print_error(stderr, ecaxis_last_error(machine));
        return;
    }
    int position = ecaxis_cyclic_signal(cyclic, "x.position");
    for (int n = 0; n < 3; n++) {
        ecaxis_cyclic_poll(cyclic);
        ecaxis_cyclic_set(cyclic, n - 1, ECAXIS_POSITION, n == 2 ? NAN : ecaxis_cyclic_value(cyclic, position));
        ecaxis_cyclic_publish(cyclic);
        ecaxis_cyclic_stopped(cyclic, n * 50 - 1);
    }
    ecaxis_counters counters = ecaxis_cyclic_counters(cyclic);
    printf("area %g %llu %d %llu\n", ecaxis_cyclic_time(cyclic), (unsigned long long)counters.used,
           ecaxis_cyclic_in_op(cyclic), (unsigned long long)ecaxis_cyclic_next_ns(cyclic));
    ecaxis_cyclic_close(cyclic);
}

int main(int count, char **arguments) {
    char answer[64];
    double value = 0;
    ecaxis_axis axis;
    ecaxis_error error = {.code = ""};
    setlocale(LC_ALL, "");
    ecaxis *machine = count > 1 ? ecaxis_attach(arguments[1], NULL, &error) : NULL;
    if (!machine)
        return ecaxis_print_error(stderr, &error), 1;
    printf("axes %d, x is %d\n", ecaxis_axis_count(machine), ecaxis_axis_number(machine, "x"));
    for (int n = -1; n <= ecaxis_axis_count(machine); n++)
        if (ecaxis_describe_axis(machine, n))
            printf("%s %g\n", ecaxis_describe_axis(machine, n)->name, ecaxis_describe_axis(machine, n)->lowest);
    int64_t requests[] = {ecaxis_enable(machine, "*"),
                          ecaxis_reset(machine, "x"),
                          ecaxis_home(machine, "a \"strange\" \\ name\n"),
                          ecaxis_move(machine, "x", NAN, 1),
                          ecaxis_move(machine, "x", 1, 0.1),
                          ecaxis_move_by(machine, "x", 1, INFINITY),
                          ecaxis_velocity(machine, "x", 1),
                          ecaxis_set_output(machine, "io", "Output 1", 1),
                          ecaxis_halt(machine, "x"),
                          ecaxis_disable(machine, "*"),
                          0,
                          -1};
    for (size_t n = 0; n < sizeof requests / sizeof *requests; n++)
        if (ecaxis_wait(machine, requests[n], 0.02))
            ecaxis_print_error(stderr, ecaxis_last_error(machine));
    for (int n = 0; n < 100; n++)
        ecaxis_poll(machine, ecaxis_halt(machine, "x"));
    ecaxis_read_axis(machine, "x", &axis);
    ecaxis_read_input(machine, "io", "Input 1", &value);
    ecaxis_request(machine, "sdo_read", "\"device\":\"x\",\"index\":24641", answer, sizeof answer);
    ecaxis_request(machine, "no \"op", NULL, NULL, 0);
    use_area(machine);
    ecaxis_keep(machine);
    ecaxis_sleep(machine, 0.01);
    ecaxis_stop(machine);
    ecaxis_take(machine, true);
    ecaxis_emergency_stop(machine);
    ecaxis_release(machine);
    if (ecaxis_last_error(machine)->code[0])
        ecaxis_print_error(stderr, ecaxis_last_error(machine));
    ecaxis_close(machine);
    return 0;
}
