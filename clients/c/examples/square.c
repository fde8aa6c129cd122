/* Homes two axes, waits for an input, moves a square, and recovers from a fault of a drive.
 *
 *   ecaxis serve configs/square.toml --sim --socket square.sock &
 *   ./square square.sock [SQUARES] */
#include <stdio.h>
#include <stdlib.h>

#include "ecaxis.h"

static ecaxis *machine;

static void fail(void) {
    ecaxis_print_error(stderr, ecaxis_last_error(machine));
    ecaxis_stop(machine);
    ecaxis_close(machine);
    exit(1);
}

/* Ends the program unless the request reaches its end. */
static void complete(int64_t request) {
    if (ecaxis_wait(machine, request, 30))
        fail();
}

/* Returns true once the part is clamped: a switch at the first input. */
static bool is_clamped(void) {
    double value = 0;
    if (ecaxis_read_input(machine, "io", "Input 1", &value))
        fail();
    return value != 0;
}

/* Moves both axes. Returns false if one of them has failed. */
static bool move(double x, double y) {
    int64_t first = ecaxis_move(machine, "x", x, 0.3), second = ecaxis_move(machine, "y", y, 0.3);
    int failed = ecaxis_wait(machine, first, 10) + ecaxis_wait(machine, second, 10);
    return failed == 0;
}

/* Returns true if an axis has a fault, after which the program goes on; prints it. */
static bool reset_fault(void) {
    static const char *const names[] = {"x", "y"};
    bool found = false;
    if (ecaxis_stop(machine))
        fail();
    for (int n = 0; n < 2; n++) {
        ecaxis_axis axis;
        if (ecaxis_read_axis(machine, names[n], &axis))
            fail();
        if (axis.fault[0])
            printf("fault of %s: %s\n", names[n], axis.fault);
        found |= axis.fault[0] != 0;
    }
    if (!found)
        return false;
    complete(ecaxis_reset(machine, "*"));
    complete(ecaxis_enable(machine, "*"));
    return true;
}

int main(int count, char **arguments) {
    static const double corners[][2] = {{20, 0}, {20, 20}, {0, 20}, {0, 0}};
    int squares = count > 2 ? atoi(arguments[2]) : 1;
    ecaxis_error error;
    if (count < 2)
        return fprintf(stderr, "usage: %s SOCKET [SQUARES]\n", arguments[0]), 2;
    machine = ecaxis_attach(arguments[1], &(ecaxis_options){.name = "square"}, &error);
    if (!machine)
        return ecaxis_print_error(stderr, &error), 1;

    complete(ecaxis_enable(machine, "*"));
    int64_t homing[] = {ecaxis_home(machine, "x"), ecaxis_home(machine, "y")};
    complete(homing[0]);
    complete(homing[1]);
    printf("homed\n");

    complete(ecaxis_set_output(machine, "io", "Output 1", 1)); /* clamp */
    for (int tries = 0; !is_clamped(); tries++)
        if (tries > 100 || ecaxis_sleep(machine, 0.02))
            fail();
    printf("clamped\n");

    for (int done = 0; done < squares;) {
        int corner = 0;
        while (corner < 4 && is_clamped() && move(corners[corner][0], corners[corner][1]))
            corner++;
        if (corner == 4) {
            printf("square %d\n", ++done);
        } else if (!is_clamped()) {
            printf("not clamped: stop\n");
            break;
        } else {
            ecaxis_error why = *ecaxis_last_error(machine);
            if (!reset_fault()) {
                ecaxis_print_error(stderr, &why);
                fail();
            }
        }
        fflush(stdout);
    }
    complete(ecaxis_disable(machine, "*"));
    ecaxis_close(machine);
    return 0;
}
