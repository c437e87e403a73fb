/* Another thrust than that of the simulated motors, N. */
#define THRUST_MAX 0.16f
