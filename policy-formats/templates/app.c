/*
 * Out-of-tree controller that flies the policy of @name@.h.
 *
@frames@ */

#include <math.h>
#include <stdbool.h>
#include <stdint.h>

#include "FreeRTOS.h"
#include "app.h"
#include "controller.h"
#include "platform_defaults.h"
#include "stabilizer_types.h"
#include "task.h"

#include "@name@.h"

/* Rate of the stabilizer task, which calls the controller, Hz. */
#define STABILIZER_RATE @stabilizer_rate@

/* Target of the policy, m. The setpoint of the drone is moved to it. */
static const float target[3] = { @target@ };

/* Thrust coefficient of a rotor of @drone@, N/rpm^2. */
#define THRUST_COEFFICIENT @thrust_coefficient@
/* Thrust of a motor of the Crazyflie at full power, N. */
#ifndef THRUST_MAX
#define THRUST_MAX @thrust_max@
#endif
@speeds@/* rad/s per deg/s. */
#define RADIANS @radians@

/* Entry of the action for M1 to M4. */
static const int entry_of[4] = { @entries@ };

static float forces[4];
@memory@
/* Returns the speed of a motor for an action, rpm. */
static float speed(float action)
{
    return @speed@;
}

/* Computes the observation from the estimate and the setpoint. */
static void observe(const state_t *state, const sensorData_t *sensors, const setpoint_t *setpoint,
                    float observation[@NAME@_OBSERVATION_SIZE])
{
    const float dx = state->position.x - setpoint->position.x;
    const float dy = state->position.y - setpoint->position.y;
    const float w = state->attitudeQuaternion.w;
    const float x = @quaternion_x@;
    const float y = @quaternion_y@;
    const float z = state->attitudeQuaternion.z;
    const float sine = 2.0f * (w * y - z * x);

    observation[@NAME@_OBSERVATION_POSITION_X] = target[0] + @dx@;
    observation[@NAME@_OBSERVATION_POSITION_Y] = target[1] + @dy@;
    observation[@NAME@_OBSERVATION_POSITION_Z] = target[2] + state->position.z - setpoint->position.z;
    observation[@NAME@_OBSERVATION_ROLL] = atan2f(2.0f * (w * x + y * z), 1.0f - 2.0f * (x * x + y * y));
    observation[@NAME@_OBSERVATION_PITCH] = asinf(sine < -1.0f ? -1.0f : sine > 1.0f ? 1.0f : sine);
    observation[@NAME@_OBSERVATION_YAW] = atan2f(2.0f * (w * z + x * y), 1.0f - 2.0f * (y * y + z * z));
    observation[@NAME@_OBSERVATION_VELOCITY_X] = @velocity_x@;
    observation[@NAME@_OBSERVATION_VELOCITY_Y] = @velocity_y@;
    observation[@NAME@_OBSERVATION_VELOCITY_Z] = state->velocity.z;
    observation[@NAME@_OBSERVATION_ANGULAR_VELOCITY_X] = RADIANS * @rate_x@;
    observation[@NAME@_OBSERVATION_ANGULAR_VELOCITY_Y] = RADIANS * @rate_y@;
    observation[@NAME@_OBSERVATION_ANGULAR_VELOCITY_Z] = RADIANS * sensors->gyro.z;
}

void appMain(void)
{
    while (true) {
        vTaskDelay(M2T(1000));
    }
}

void controllerOutOfTreeInit(void)
{
    for (int motor = 0; motor < 4; motor++) {
        forces[motor] = 0.0f;
    }
@clear@}

bool controllerOutOfTreeTest(void)
{
    return true;
}

void controllerOutOfTree(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors,
                         const state_t *state, const uint32_t step)
{
    const bool has_target =
        setpoint->mode.x == modeAbs && setpoint->mode.y == modeAbs && setpoint->mode.z == modeAbs;
    /* The rate of the policy need not divide the rate of the task: the evaluations are spread evenly. */
    const bool due = (step % STABILIZER_RATE) * @NAME@_RATE % STABILIZER_RATE < @NAME@_RATE;

    if (!has_target) {
        controllerOutOfTreeInit();
    } else if (due) {
        static float observation[@NAME@_OBSERVATION_SIZE];
        static float action[@NAME@_ACTION_SIZE];

        observe(state, sensors, setpoint, observation);
        @name@_evaluate(observation, @memory_argument@action);
        for (int motor = 0; motor < 4; motor++) {
            const float rpm = speed(action[entry_of[motor]]);
            const float share = THRUST_COEFFICIENT * rpm * rpm / THRUST_MAX;

            forces[motor] = share > 1.0f ? 1.0f : share;
        }
    }
    control->controlMode = controlModeForce;
    for (int motor = 0; motor < 4; motor++) {
        control->normalizedForces[motor] = forces[motor];
    }
}
