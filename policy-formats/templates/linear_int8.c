static void linear(const signed char *weights, const float *scales, const float *biases, int inputs, int outputs,
                   const float *x, float *y)
{
    const signed char *row = weights;
    int j = 0;

    for (; j + 4 <= outputs; j += 4) {
        float sum0 = 0.0f;
        float sum1 = 0.0f;
        float sum2 = 0.0f;
        float sum3 = 0.0f;

        for (int i = 0; i < inputs; i++) {
            sum0 += x[i] * (float)row[i];
            sum1 += x[i] * (float)row[inputs + i];
            sum2 += x[i] * (float)row[2 * inputs + i];
            sum3 += x[i] * (float)row[3 * inputs + i];
        }
        y[j] = biases[j] + scales[j] * sum0;
        y[j + 1] = biases[j + 1] + scales[j + 1] * sum1;
        y[j + 2] = biases[j + 2] + scales[j + 2] * sum2;
        y[j + 3] = biases[j + 3] + scales[j + 3] * sum3;
        row += 4 * inputs;
    }
    for (; j < outputs; j++) {
        float sum = 0.0f;

        for (int i = 0; i < inputs; i++) {
            sum += x[i] * (float)row[i];
        }
        y[j] = biases[j] + scales[j] * sum;
        row += inputs;
    }
}

