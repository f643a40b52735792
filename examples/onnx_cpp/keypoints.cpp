// Keypoints of an image by ONNX Runtime, with a file of `deepdetect export onnx`:
// keypoints MODEL.onnx PHOTO.ppm [PROBABILITY]
// prints "x y size angle score" of the best points of all scales; with a probability "x y probability" of
// each pixel over it.
#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

struct Image {
    int64_t width = 0, height = 0;
    std::vector<uint8_t> rgb;
};

// Binary PPM (P6) of 8 bits without comments: what most programs write, and needs no library.
Image read_ppm(const char* path) {
    std::ifstream file(path, std::ios::binary);
    std::string kind;
    Image image;
    int largest = 0;
    if (!(file >> kind >> image.width >> image.height >> largest) || kind != "P6" || largest != 255 ||
        std::min(image.width, image.height) < 1 || std::max(image.width, image.height) > 99999)
        throw std::runtime_error(std::string(path) + " is missing, or no binary PPM of 8 bits");
    file.get();
    image.rgb.resize(3 * image.width * image.height);
    if (!file.read(reinterpret_cast<char*>(image.rgb.data()), image.rgb.size()))
        throw std::runtime_error(std::string(path) + " is cut off");
    return image;
}

int main(int count, char** words) try {
    char* end = nullptr;
    const float threshold = count > 3 ? std::strtof(words[3], &end) : 0;
    if (count < 3 || (end && (end == words[3] || *end)))
        throw std::runtime_error("usage: keypoints MODEL.onnx PHOTO.ppm [PROBABILITY]");
    const Image image = read_ppm(words[2]);
    const int64_t pixels = image.width * image.height;
    std::vector<float> planes(3 * pixels);  // RGB from 0 to 1, one channel after the other
    for (int64_t k = 0; k < pixels; k++)
        for (int64_t c = 0; c < 3; c++) planes[c * pixels + k] = image.rgb[3 * k + c] / 255.0f;

    Ort::Env env(ORT_LOGGING_LEVEL_ERROR, "keypoints");
    Ort::Session session(env, words[1], Ort::SessionOptions());
    const int64_t shape[] = {1, 3, image.height, image.width};  // any height and width
    auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
    auto input = Ort::Value::CreateTensor<float>(memory, planes.data(), planes.size(), shape, 4);
    const char *inputs[] = {"image"}, *maps[] = {"probability"};
    const char* points[] = {"keypoints", "scores", "sizes", "angles"};
    if (threshold > 0) {
        auto found = session.Run(Ort::RunOptions(), inputs, &input, 1, maps, 1);
        const float* probability = found[0].GetTensorData<float>();
        for (int64_t k = 0; k < pixels; k++)
            if (probability[k] > threshold)
                std::printf("%d %d %.6f\n", int(k % image.width), int(k / image.width), probability[k]);
        return 0;
    }
    auto found = session.Run(Ort::RunOptions(), inputs, &input, 1, points, 4);
    const float *xy = found[0].GetTensorData<float>(), *scores = found[1].GetTensorData<float>();
    const float *sizes = found[2].GetTensorData<float>(), *angles = found[3].GetTensorData<float>();
    const int64_t most = found[1].GetTensorTypeAndShapeInfo().GetElementCount();
    for (int64_t k = 0; k < most && scores[k] > 0; k++)  // 0 behind the last point
        std::printf("%.3f %.3f %.2f %.2f %.6f\n", xy[2 * k], xy[2 * k + 1], sizes[k], angles[k],
                    scores[k]);
} catch (const std::exception& error) {
    std::fprintf(stderr, "keypoints: %s\n", error.what());
    return 2;
}
