// A plain multi-threaded C++ compositor for 2D Gaussians over per-tile depth-sorted
// lists: the yardstick that the JAX compositor is measured against. float32, no
// early termination, no tricks beyond loops that the compiler can vectorise: the
// outer loop runs over the Gaussians of a tile, the inner one over its pixels, with
// selects in place of branches.
//
//   sigma = 0.5 (a dx^2 + c dy^2) + b dx dy      with (dx, dy) = mean - pixel centre
//   alpha = min(0.99, opacity exp(-sigma))       0 if alpha < 1/255 or sigma < 0
//   T_i   = prod_{j<i} (1 - alpha_j)
//   C     = sum_i color_i alpha_i T_i + T_final background
//
// Build: g++ -O3 -march=native -ffast-math -std=c++17 -shared -fPIC -pthread

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <thread>
#include <vector>
#if defined(__SSE__)
#include <xmmintrin.h>
#endif

namespace {

constexpr float kMinAlpha = 1.0f / 255.0f;
constexpr float kMaxAlpha = 0.99f;
// The backward pass recovers T by division. Without early termination T can
// underflow, so the forward pass saves it every kSave Gaussians (0.01^16 > FLT_MIN).
constexpr int kSave = 16;
constexpr int kGrads = 9;  // mean x y, conic a b c, opacity, color r g b

struct Scene {
  const float *means2d, *conics, *opacities, *colors;  // [N,2] [N,3] [N] [N,3]
  const int32_t *tile_ranges, *ids;                    // [T,2] [P]
  int width, height;
  const float *background;  // [3]
};

struct Splat {
  float x, y, a, b, c, opacity, red, green, blue;
  Splat(const Scene &s, int64_t i)
      : x(s.means2d[2 * i]), y(s.means2d[2 * i + 1]), a(s.conics[3 * i]),
        b(s.conics[3 * i + 1]), c(s.conics[3 * i + 2]), opacity(s.opacities[i]),
        red(s.colors[3 * i]), green(s.colors[3 * i + 1]), blue(s.colors[3 * i + 2]) {}
};

// One tile of SIZE x SIZE pixels; the pixels beyond the image border are computed
// but neither read nor written.
template <int SIZE>
struct Tile {
  static constexpr int n = SIZE * SIZE;
  alignas(64) float px[n], py[n];            // pixel centres
  alignas(64) float red[n], green[n], blue[n];
  alignas(64) float T[n];                    // transmittance
  alignas(64) float raw[n];                  // opacity exp(-sigma), or 0
  alignas(64) float vr[n], vg[n], vb[n];     // cotangent of the image
  alignas(64) float behind[n];               // sum over what lies behind, times v
  std::vector<float> saved;                  // T before Gaussians 0, kSave, 2 kSave...
  int x0, y0, columns, rows;

  Tile(const Scene &s, int tile) {
    const int across = (s.width + SIZE - 1) / SIZE;
    x0 = tile % across * SIZE, y0 = tile / across * SIZE;
    columns = std::min(SIZE, s.width - x0), rows = std::min(SIZE, s.height - y0);
    for (int i = 0; i < n; i++) {
      px[i] = x0 + i % SIZE + 0.5f, py[i] = y0 + i / SIZE + 0.5f;
      red[i] = green[i] = blue[i] = 0.0f, T[i] = 1.0f;
    }
  }

  // f(index of the pixel in the image, index of the pixel in the tile)
  template <class F>
  void each_pixel(const Scene &s, F f) {
    for (int r = 0; r < rows; r++)
      for (int q = 0; q < columns; q++)
        f(int64_t(y0 + r) * s.width + x0 + q, r * SIZE + q);
  }

  void evaluate(const Splat g) {
    for (int i = 0; i < n; i++) {
      const float dx = g.x - px[i], dy = g.y - py[i];
      const float sigma = 0.5f * (g.a * dx * dx + g.c * dy * dy) + g.b * dx * dy;
      // The vectorised exp takes a slow path where its result would underflow.
      const float value = g.opacity * std::exp(-std::min(sigma, 80.0f));
      raw[i] = (sigma >= 0.0f) & (value >= kMinAlpha) ? value : 0.0f;
    }
  }

  void forward(const Scene &s, int begin, int end, bool save) {
    if (save) saved.reserve((int64_t(end - begin) / kSave + 1) * n);
    for (int k = begin; k < end; k++) {
      if (save && (k - begin) % kSave == 0) saved.insert(saved.end(), T, T + n);
      const Splat g(s, s.ids[k]);
      evaluate(g);
      for (int i = 0; i < n; i++) {
        const float alpha = std::min(kMaxAlpha, raw[i]);
        const float weight = alpha * T[i];
        red[i] += g.red * weight;
        green[i] += g.green * weight;
        blue[i] += g.blue * weight;
        T[i] -= weight;
      }
    }
  }

  void write(const Scene &s, float *image, float *transmittance) {
    const float *bg = s.background;
    each_pixel(s, [&](int64_t p, int i) {
      image[3 * p] = red[i] + T[i] * bg[0];
      image[3 * p + 1] = green[i] + T[i] * bg[1];
      image[3 * p + 2] = blue[i] + T[i] * bg[2];
      transmittance[p] = T[i];
    });
  }

  // Back to front, after forward(..., save = true); adds to grads [N,9].
  //   dL/dalpha_i = T_i (color_i . v) - behind_i / (1 - alpha_i)
  //   behind_i = sum_{j>i} alpha_j T_j (color_j . v)
  //              + T_final (background . v - v_alpha)
  void backward(const Scene &s, int begin, int end, const float *v_image,
                const float *v_alpha, float *grads) {
    const float *bg = s.background;
    for (int i = 0; i < n; i++) vr[i] = vg[i] = vb[i] = behind[i] = 0.0f;
    each_pixel(s, [&](int64_t p, int i) {
      vr[i] = v_image[3 * p], vg[i] = v_image[3 * p + 1], vb[i] = v_image[3 * p + 2];
      behind[i] = T[i] * (bg[0] * vr[i] + bg[1] * vg[i] + bg[2] * vb[i] - v_alpha[p]);
    });
    for (int k = end - 1; k >= begin; k--) {
      if ((k + 1 - begin) % kSave == 0 && k + 1 < end)
        std::copy_n(saved.data() + int64_t(k + 1 - begin) / kSave * n, n, T);
      const Splat g(s, s.ids[k]);
      evaluate(g);
      float sr = 0, sg = 0, sb = 0, s0 = 0, sx = 0, sy = 0, sxx = 0, sxy = 0, syy = 0;
      for (int i = 0; i < n; i++) {
        const float alpha = std::min(kMaxAlpha, raw[i]);
        const float inverse = 1.0f / (1.0f - alpha);
        const float before = T[i] * inverse;
        const float weight = alpha * before;
        const float cv = g.red * vr[i] + g.green * vg[i] + g.blue * vb[i];
        sr += weight * vr[i];
        sg += weight * vg[i];
        sb += weight * vb[i];
        const float v = before * cv - behind[i] * inverse;
        behind[i] += weight * cv;
        T[i] = before;
        const float m = (raw[i] < kMaxAlpha ? raw[i] : 0.0f) * v;  // -dL/dsigma
        const float dx = g.x - px[i], dy = g.y - py[i];
        const float mx = m * dx, my = m * dy;
        s0 += m, sx += mx, sy += my;
        sxx += mx * dx, sxy += mx * dy, syy += my * dy;
      }
      float *d = grads + int64_t(kGrads) * s.ids[k];
      d[0] -= g.a * sx + g.b * sy, d[1] -= g.b * sx + g.c * sy;
      d[2] -= 0.5f * sxx, d[3] -= sxy, d[4] -= 0.5f * syy;
      d[5] += g.opacity > 0.0f ? s0 / g.opacity : 0.0f;
      d[6] += sr, d[7] += sg, d[8] += sb;
    }
  }

  // The same gradient the way GPU code has it: one pixel after another, each walking
  // the list on its own and adding to the Gaussians as it goes. Not vectorised.
  void backward_by_pixel(const Scene &s, int begin, int end, const float *v_image,
                         const float *v_alpha, float *grads) {
    const float *bg = s.background;
    each_pixel(s, [&](int64_t p, int i) {
      const float *v = v_image + 3 * p;
      float after = T[i];
      float rest = after * (bg[0] * v[0] + bg[1] * v[1] + bg[2] * v[2] - v_alpha[p]);
      for (int k = end - 1; k >= begin; k--) {
        if ((k + 1 - begin) % kSave == 0 && k + 1 < end)
          after = saved[int64_t(k + 1 - begin) / kSave * n + i];
        const Splat g(s, s.ids[k]);
        const float dx = g.x - px[i], dy = g.y - py[i];
        const float sigma = 0.5f * (g.a * dx * dx + g.c * dy * dy) + g.b * dx * dy;
        const float value = g.opacity * std::exp(-sigma);
        if (sigma < 0.0f || value < kMinAlpha) continue;
        const float alpha = std::min(kMaxAlpha, value);
        const float inverse = 1.0f / (1.0f - alpha);
        const float before = after * inverse, weight = alpha * before;
        const float cv = g.red * v[0] + g.green * v[1] + g.blue * v[2];
        float *d = grads + int64_t(kGrads) * s.ids[k];
        d[6] += weight * v[0], d[7] += weight * v[1], d[8] += weight * v[2];
        const float va = before * cv - rest * inverse;
        rest += weight * cv;
        after = before;
        if (value >= kMaxAlpha) continue;
        const float m = value * va;
        d[0] -= m * (g.a * dx + g.b * dy), d[1] -= m * (g.b * dx + g.c * dy);
        d[2] -= 0.5f * m * dx * dx, d[3] -= m * dx * dy, d[4] -= 0.5f * m * dy * dy;
        d[5] += m / g.opacity;
      }
    });
  }
};

// work(thread index) on each of `threads` new threads. Denormals are flushed to zero
// in these threads alone: the caller's floating-point state stays as it is.
template <class F>
void parallel(int threads, F work) {
  std::vector<std::thread> pool;
  for (int t = 0; t < threads; t++)
    pool.emplace_back([&work, t] {
#if defined(__SSE__)
      _mm_setcsr(_mm_getcsr() | 0x8040);
#endif
      work(t);
    });
  for (auto &thread : pool) thread.join();
}

// Forward pass and, if grads is not null, backward pass; grads [N,9] is overwritten.
template <int SIZE>
void run(const Scene &s, int count, int threads, float *image, float *transmittance,
         const float *v_image, const float *v_alpha, float *grads, bool by_pixel) {
  const int64_t across = (s.width + SIZE - 1) / SIZE;
  const int64_t tiles = across * ((s.height + SIZE - 1) / SIZE);
  const int64_t size = int64_t(kGrads) * count;
  std::atomic<int64_t> next{0};
  std::vector<std::vector<float>> sums(threads);  // private to each thread
  parallel(threads, [&](int t) {
    if (grads) sums[t].assign(size, 0.0f);
    for (int64_t i; (i = next++) < tiles;) {
      const int begin = s.tile_ranges[2 * i], end = s.tile_ranges[2 * i + 1];
      Tile<SIZE> tile(s, int(i));
      tile.forward(s, begin, end, grads != nullptr);
      tile.write(s, image, transmittance);
      if (grads && by_pixel)
        tile.backward_by_pixel(s, begin, end, v_image, v_alpha, sums[t].data());
      else if (grads)
        tile.backward(s, begin, end, v_image, v_alpha, sums[t].data());
    }
  });
  if (!grads) return;
  parallel(threads, [&](int t) {
    const int64_t from = size * t / threads, to = size * (t + 1) / threads;
    std::copy(sums[0].data() + from, sums[0].data() + to, grads + from);
    for (int u = 1; u < threads; u++)
      for (int64_t i = from; i < to; i++) grads[i] += sums[u][i];
  });
}

int dispatch(int tile_size, const Scene &s, int count, int threads, float *image,
             float *transmittance, const float *v_image, const float *v_alpha,
             float *grads, bool by_pixel) {
  auto *f = tile_size == 8 ? run<8> : tile_size == 16 ? run<16>
          : tile_size == 32 ? run<32> : nullptr;
  if (!f) return 1;
  f(s, count, std::max(1, threads), image, transmittance, v_image, v_alpha, grads,
    by_pixel);
  return 0;
}

}  // namespace

// Both return 0, or 1 for a tile size other than 8, 16 or 32. Sizes: image and v_image
// [H,W,3], transmittance and v_alpha [H,W]; the cotangent v_alpha is of 1 - T_final.
extern "C" int yardstick_forward(
    const float *means2d, const float *conics, const float *opacities,
    const float *colors, const int32_t *tile_ranges, const int32_t *ids, int count,
    int width, int height, int tile_size, const float *background, int threads,
    float *image, float *transmittance) {
  const Scene s{means2d, conics, opacities, colors, tile_ranges, ids, width, height,
                background};
  return dispatch(tile_size, s, count, threads, image, transmittance, nullptr, nullptr,
                  nullptr, false);
}

// The forward pass of each tile followed by its backward pass. grads [N,9] receives
// (mean x y, conic a b c, opacity, color r g b) of each Gaussian. by_pixel chooses the
// loop over pixels outside (plain) or inside (vectorised).
extern "C" int yardstick_backward(
    const float *means2d, const float *conics, const float *opacities,
    const float *colors, const int32_t *tile_ranges, const int32_t *ids, int count,
    int width, int height, int tile_size, const float *background, int threads,
    int by_pixel, const float *v_image, const float *v_alpha, float *image, float *transmittance,
    float *grads) {
  const Scene s{means2d, conics, opacities, colors, tile_ranges, ids, width, height,
                background};
  return dispatch(tile_size, s, count, threads, image, transmittance, v_image, v_alpha,
                  grads, by_pixel != 0);
}
