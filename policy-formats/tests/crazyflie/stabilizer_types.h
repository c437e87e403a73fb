/* What the generated application uses of the firmware's types. */
#ifndef STABILIZER_TYPES_H
#define STABILIZER_TYPES_H

#include <stdbool.h>
#include <stdint.h>

struct axes {
    uint32_t timestamp;
    float x;
    float y;
    float z;
};

typedef struct {
    float x;
    float y;
    float z;
} Axis3f;

typedef struct {
    uint32_t timestamp;
    float x;
    float y;
    float z;
    float w;
} quaternion_t;

typedef struct {
    Axis3f acc;
    Axis3f gyro;
} sensorData_t;

typedef struct {
    quaternion_t attitudeQuaternion;
    struct axes position;
    struct axes velocity;
} state_t;

typedef enum { controlModeLegacy = 0, controlModeForceTorque = 1, controlModeForce = 2 } control_mode_t;

typedef struct {
    float normalizedForces[4];
    control_mode_t controlMode;
} control_t;

typedef enum { modeDisable = 0, modeAbs, modeVelocity } stab_mode_t;

typedef struct {
    struct axes position;
    struct {
        stab_mode_t x;
        stab_mode_t y;
        stab_mode_t z;
    } mode;
} setpoint_t;

#endif
