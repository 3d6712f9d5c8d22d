# A CPU image. docker build -t scene-experts . ; docker run --rm -v "$PWD:/work" scene-experts train scene-experts --data CAPTURE --out RUN
FROM python:3.11-slim AS build
RUN apt-get update && apt-get install -y --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
COPY . /source
RUN pip wheel --no-deps -w /wheels /source

FROM python:3.11-slim
RUN apt-get update && apt-get install -y --no-install-recommends libgl1 libgomp1 && rm -rf /var/lib/apt/lists/*
COPY --from=build /wheels /wheels
COPY constraints.txt /
RUN pip install --no-cache-dir -c /constraints.txt "$(ls /wheels/*.whl)[sfm,viewer,video,plots]"
WORKDIR /work
ENTRYPOINT ["scene-experts"]
CMD ["--help"]
