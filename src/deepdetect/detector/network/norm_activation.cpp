// Batch normalisation with PReLU, and the way back: see norm_activation.py.
//
// Maps are bfloat16, channels last: the channels of a pixel lie together. Sums over pixels are
// made in float32 over short stretches and in float64 beyond, in an order that depends on nothing
// but the number of threads.

#include <omp.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <numeric>
#include <vector>

namespace {

using bfloat16 = std::uint16_t;
using Index = std::int64_t;

constexpr Index VECTOR = 32;     // bfloat16 values in the widest vectors
constexpr Index STRETCH = 8192;  // values, about, that are summed in float32, in the first cache

inline float widen(bfloat16 value) {
    const std::uint32_t bits = std::uint32_t(value) << 16;
    float wide;
    std::memcpy(&wide, &bits, sizeof wide);
    return wide;
}

inline bfloat16 round_to_even(float value) {
    std::uint32_t bits;
    std::memcpy(&bits, &value, sizeof bits);
    return bfloat16((bits + 0x7fff + ((bits >> 16) & 1)) >> 16);
}

// Maps go by in stretches of whole periods. A period repeats what belongs to the channels until
// it fills vectors, so that the loops have no rests, whatever the number of channels.
struct Stretches {
    Index channels, period, length, pixels, values, count;

    Stretches(Index channels, Index pixels)
        : channels(channels),
          period(std::lcm(channels, VECTOR)),
          length(std::max<Index>(1, STRETCH / period) * period),
          pixels(pixels),
          values(channels * pixels),
          count((values + length - 1) / length) {}

    Index last(Index stretch) const { return std::min(values, (stretch + 1) * length); }

    std::vector<float> repeat(const std::vector<double>& of_channels) const {
        std::vector<float> repeated(period);
        for (Index j = 0; j < period; ++j) repeated[j] = float(of_channels[j % channels]);
        return repeated;
    }

    // Call work(first, length) for every period, in as many threads as there are.
    template <typename Work>
    void each(Work work) const {
#pragma omp parallel for schedule(static)
        for (Index k = 0; k < count; ++k)
            for (Index first = k * length; first < last(k); first += period)
                work(first, std::min(period, values - first));
    }

    // Sum `sums` terms for each channel: add(first, length, part) adds those of a period to
    // part[sum * period + place in the period].
    template <int sums, typename Add>
    std::vector<std::vector<double>> sum(Add add) const {
        const Index width = sums * period;
        std::vector<double> owns(omp_get_max_threads() * width, 0.0);
#pragma omp parallel
        {
            std::vector<float> part(width);
            double* own = owns.data() + omp_get_thread_num() * width;
#pragma omp for schedule(static)
            for (Index k = 0; k < count; ++k) {
                std::fill(part.begin(), part.end(), 0.0f);
                for (Index first = k * length; first < last(k); first += period)
                    add(first, std::min(period, values - first), part.data());
                for (Index j = 0; j < width; ++j) own[j] += part[j];
            }
        }
        std::vector<std::vector<double>> totals(sums, std::vector<double>(channels, 0.0));
        for (std::size_t k = 0; k < owns.size(); ++k)
            totals[k % width / period][k % period % channels] += owns[k];
        return totals;
    }
};

// The normalised value is gain * value + offset.
struct Line {
    std::vector<double> scale, gain, offset;

    Line(Index channels, const double* mean, const double* variance, const float* weight,
         const float* bias, double epsilon)
        : scale(channels), gain(channels), offset(channels) {
        for (Index c = 0; c < channels; ++c) {
            scale[c] = 1 / std::sqrt(variance[c] + epsilon);
            gain[c] = weight[c] * scale[c];
            offset[c] = bias[c] - mean[c] * gain[c];
        }
    }
};

// The loops over one period. What they read and write does not overlap.

inline void add_statistics(const bfloat16* __restrict x, Index length, float* __restrict sum,
                           float* __restrict squares) {
    for (Index j = 0; j < length; ++j) {
        const float value = widen(x[j]);
        sum[j] += value;
        squares[j] += value * value;
    }
}

inline void activate(const bfloat16* __restrict x, Index length, const float* __restrict gain,
                     const float* __restrict offset, const float* __restrict slope,
                     bfloat16* __restrict made) {
    for (Index j = 0; j < length; ++j) {
        const float normal = widen(x[j]) * gain[j] + offset[j];
        made[j] = round_to_even(normal > 0 ? normal : normal * slope[j]);
    }
}

// Sums of the gradient and of its product with x, over all pixels and where the normalised x is
// below zero.
inline void add_gradients(const bfloat16* __restrict x, const bfloat16* __restrict gradient,
                          Index length, const float* __restrict gain,
                          const float* __restrict offset, float* __restrict all,
                          float* __restrict all_x, float* __restrict low,
                          float* __restrict low_x) {
    for (Index j = 0; j < length; ++j) {
        const float value = widen(x[j]), given = widen(gradient[j]);
        const float below = value * gain[j] + offset[j] > 0 ? 0.0f : given;
        all[j] += given;
        all_x[j] += given * value;
        low[j] += below;
        low_x[j] += below * value;
    }
}

inline void pass_back(const bfloat16* __restrict x, const bfloat16* __restrict gradient,
                      Index length, const float* __restrict gain,
                      const float* __restrict offset, const float* __restrict gain_below,
                      const float* __restrict by_x, const float* __restrict rest,
                      bfloat16* __restrict of_x) {
    for (Index j = 0; j < length; ++j) {
        const float value = widen(x[j]);
        const float factor = value * gain[j] + offset[j] > 0 ? gain[j] : gain_below[j];
        of_x[j] = round_to_even(widen(gradient[j]) * factor + value * by_x[j] + rest[j]);
    }
}

}  // namespace

extern "C" {

// Normalise x and apply the PReLU.
void forward(const bfloat16* x, Index channels, Index pixels, const float* weight,
             const float* bias, const float* slope, double epsilon, double* mean,
             double* variance, bfloat16* made) {
    const Stretches stretches(channels, pixels);
    const Index period = stretches.period;
    const auto totals = stretches.sum<2>([&](Index first, Index length, float* part) {
        add_statistics(x + first, length, part, part + period);
    });
    for (Index c = 0; c < channels; ++c) {
        mean[c] = totals[0][c] / pixels;
        variance[c] = totals[1][c] / pixels - mean[c] * mean[c];
        if (variance[c] < 0) variance[c] = 0;  // by rounding; what is no number stays so
    }
    const Line line(channels, mean, variance, weight, bias, epsilon);
    const auto gain = stretches.repeat(line.gain), offset = stretches.repeat(line.offset);
    const auto below = stretches.repeat({slope, slope + channels});
    stretches.each([&](Index first, Index length) {
        activate(x + first, length, gain.data(), offset.data(), below.data(), made + first);
    });
}

// The gradients of x and of the parameters.
void backward(const bfloat16* x, const bfloat16* gradient, Index channels, Index pixels,
              const float* weight, const float* bias, const float* slope, const double* mean,
              const double* variance, double epsilon, bfloat16* of_x, float* of_weight,
              float* of_bias, float* of_slope) {
    const Stretches stretches(channels, pixels);
    const Index period = stretches.period;
    const Line line(channels, mean, variance, weight, bias, epsilon);
    const auto gain = stretches.repeat(line.gain), offset = stretches.repeat(line.offset);
    const auto totals = stretches.sum<4>([&](Index first, Index length, float* part) {
        add_gradients(x + first, gradient + first, length, gain.data(), offset.data(), part,
                      part + period, part + 2 * period, part + 3 * period);
    });
    std::vector<double> gain_below(channels), by_x(channels), rest(channels);
    for (Index c = 0; c < channels; ++c) {
        const double all = totals[0][c], all_x = totals[1][c];
        const double low = totals[2][c], low_x = totals[3][c];
        const double bias_c = all + (slope[c] - 1) * low;
        const double weight_c =
            line.scale[c] * (all_x + (slope[c] - 1) * low_x - mean[c] * bias_c);
        of_slope[c] = float(line.gain[c] * low_x + line.offset[c] * low);
        of_bias[c] = float(bias_c);
        of_weight[c] = float(weight_c);
        gain_below[c] = line.gain[c] * slope[c];
        by_x[c] = -line.gain[c] * line.scale[c] * weight_c / pixels;
        rest[c] = -line.gain[c] * bias_c / pixels - by_x[c] * mean[c];
    }
    const auto below = stretches.repeat(gain_below);
    const auto slant = stretches.repeat(by_x), level = stretches.repeat(rest);
    stretches.each([&](Index first, Index length) {
        pass_back(x + first, gradient + first, length, gain.data(), offset.data(), below.data(),
                  slant.data(), level.data(), of_x + first);
    });
}

}  // extern "C"
