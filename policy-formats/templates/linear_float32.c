static void linear(const float *weights, const float *biases, int inputs, int outputs, const float *x, float *y)
{
    const float *row = weights;
    int j = 0;

    for (; j + 4 <= outputs; j += 4) {
        float sum0 = biases[j];
        float sum1 = biases[j + 1];
        float sum2 = biases[j + 2];
        float sum3 = biases[j + 3];

        for (int i = 0; i < inputs; i++) {
            sum0 += x[i] * row[i];
            sum1 += x[i] * row[inputs + i];
            sum2 += x[i] * row[2 * inputs + i];
            sum3 += x[i] * row[3 * inputs + i];
        }
        y[j] = sum0;
        y[j + 1] = sum1;
        y[j + 2] = sum2;
        y[j + 3] = sum3;
        row += 4 * inputs;
    }
    for (; j < outputs; j++) {
        float sum = biases[j];

        for (int i = 0; i < inputs; i++) {
            sum += x[i] * row[i];
        }
        y[j] = sum;
        row += inputs;
    }
}

