# Cross-compile for 64-bit ARM: cmake -S . -B build/arm -DCMAKE_TOOLCHAIN_FILE=tests/cross/aarch64-linux-gnu.cmake -DSCENE_EXPERTS_CHECK=ON
set(CMAKE_SYSTEM_NAME Linux)
set(CMAKE_SYSTEM_PROCESSOR aarch64)
set(CMAKE_CXX_COMPILER aarch64-linux-gnu-g++)
