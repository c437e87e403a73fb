/* Calls the controller for every state on standard input, and writes the forces to standard output. */
#include <stdio.h>

#include "app.h"
#include "controller.h"
#include "task.h"

void vTaskDelay(int ticks)
{
    (void)ticks;
}

int main(void)
{
    uint32_t step = 0;
    /* position, quaternion w x y z, velocity, angular velocity in deg/s, setpoint, mode */
    float input[17];

    controllerOutOfTreeInit();
    if (!controllerOutOfTreeTest()) {
        return 1;
    }
    while (fread(input, sizeof(float), 17, stdin) == 17) {
        state_t state = {
            .attitudeQuaternion = { 0, input[4], input[5], input[6], input[3] },
            .position = { 0, input[0], input[1], input[2] },
            .velocity = { 0, input[7], input[8], input[9] },
        };
        sensorData_t sensors = { .gyro = { input[10], input[11], input[12] } };
        const stab_mode_t mode = input[16] > 0.0f ? modeAbs : modeDisable;
        setpoint_t setpoint = { { 0, input[13], input[14], input[15] }, { mode, mode, mode } };
        control_t control = { { 0 }, controlModeLegacy };

        controllerOutOfTree(&control, &setpoint, &sensors, &state, step++);
        if (control.controlMode != controlModeForce) {
            return 1;
        }
        fwrite(control.normalizedForces, sizeof(float), 4, stdout);
        fflush(stdout);
    }
    return 0;
}
