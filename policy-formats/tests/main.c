/* Evaluates the policy for every observation on standard input, and writes the actions to standard output. */
#include <stdio.h>

#include "trained.h"

int main(void)
{
    float observation[TRAINED_OBSERVATION_SIZE];
    float action[TRAINED_ACTION_SIZE];
#ifdef TRAINED_MEMORY_SIZE
    float memory[TRAINED_MEMORY_SIZE] = { 0.0f };
#endif

    while (fread(observation, sizeof(observation), 1, stdin) == 1) {
#ifdef TRAINED_MEMORY_SIZE
        trained_evaluate(observation, memory, action);
#else
        trained_evaluate(observation, action);
#endif
        fwrite(action, sizeof(action), 1, stdout);
    }
    return 0;
}
