static float polynomial(const float *coefficients, float x)
{
    float sum = coefficients[4];

    for (int i = 3; i >= 0; i--) {
        sum = sum * x + coefficients[i];
    }
    return sum;
}

static float hyperbolic_tangent(float x)
{
    static const float numerator[5] = { @numerator@ };
    static const float denominator[5] = { @denominator@ };
    const float bounded = clipped(x, -@bound@, @bound@);
    const float square = bounded * bounded;

    return bounded * polynomial(numerator, square) / polynomial(denominator, square);
}

static float logistic(float x)
{
    return 0.5f + 0.5f * hyperbolic_tangent(0.5f * x);
}

