static void activate(int count, float *x)
{
    for (int i = 0; i < count; i++) {
        x[i] = x[i] / (1.0f + (x[i] < 0.0f ? -x[i] : x[i]));
    }
}

