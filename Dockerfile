# An image that trains on the CPU. docker build -t scene-experts . ; docker run --rm -v "$PWD:/work" scene-experts train scene-experts --data CAPTURE --out RUN
# On x86-64 the default torch is a CUDA build of several GB. For a small image: --build-arg TORCH_INDEX=URL, PyTorch's index of CPU builds.
FROM python:3.11-slim AS build
RUN apt-get update && apt-get install -y --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
COPY . /source
RUN pip wheel --no-cache-dir --no-deps -w /wheels /source

FROM python:3.11-slim
ARG TORCH_INDEX=""
RUN apt-get update && apt-get install -y --no-install-recommends libgl1 libgomp1 && rm -rf /var/lib/apt/lists/*
COPY constraints.txt /
RUN pip install --no-cache-dir ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} "$(grep '^torch==' /constraints.txt)"
COPY --from=build /wheels /wheels
RUN sed '/^torch==/d' /constraints.txt > /extras.txt && pip install --no-cache-dir -c /extras.txt "$(ls /wheels/*.whl)[sfm,viewer,video,plots]"
WORKDIR /work
ENTRYPOINT ["scene-experts"]
CMD ["--help"]
