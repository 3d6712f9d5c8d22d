// What every exported function is marked with: plain C names, visible from the shared library.
#pragma once
#if defined(_WIN32)
#define SE_EXPORT extern "C" __declspec(dllexport)
#else
#define SE_EXPORT extern "C" __attribute__((visibility("default")))
#endif
